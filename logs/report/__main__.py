"""Draw the page of a recording: `python -m logs.report RECORDING PAGE`, with the pickled summary as its input.

Whoever flew starts it afterwards, so that matplotlib is never loaded into a process that flies.
"""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.report.flight_page import write_report
from uavctl.errors import UavctlError


def main() -> int:
    """Write the page; return 0, or 1 with the reason on standard error if it cannot be written."""
    recording, page = Path(sys.argv[1]), Path(sys.argv[2])
    try:
        write_report(FlightData.from_records(read(recording), recording), pickle.load(sys.stdin.buffer), page)
    except UavctlError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
