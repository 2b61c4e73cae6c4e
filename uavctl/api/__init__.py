"""Functions for Python, reached as `uavctl.load`, `uavctl.solve` and so on; docs/python.md shows them."""

from importlib.util import find_spec
from pathlib import Path

from uavctl.errors import UsageError

_PACKAGE_FOLDER = Path(__file__).parents[2]


def _check_siblings() -> None:
    """See that `sim` and `logs`, names that anybody may give a module, are those installed with this package.

    Raises:
        UsageError: Another module hides one of them.
    """
    for name in ("sim", "logs"):
        spec = find_spec(name)
        origin = None if spec is None or spec.origin is None else Path(spec.origin)
        if origin is None or origin.resolve().parents[1] != _PACKAGE_FOLDER.resolve():
            raise UsageError(
                f"module {name} is {origin or 'missing'}, not the one of uavctl in {_PACKAGE_FOLDER}; "
                "rename it, or start Python in another folder"
            )


_check_siblings()
