"""`python -m uavctl`."""

from uavctl.cli import main

if __name__ == "__main__":
    main()
