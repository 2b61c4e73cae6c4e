"""Makes the pictures of docs/reading-a-report.md and docs/quick-start.md from flights: `python tools/pictures.py`."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

from rich.console import Console
from rich.text import Text

from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.report import figures, link_figures, plots, verdict_figures
from logs.report.path_3d import draw_path_3d
from logs.report.svg import Drawing, make_standalone
from logs.report.timeline import draw_timeline
from logs.report.verdicts import judge_flight

OUT = Path(__file__).parents[1] / "docs" / "img"
WIDTH = 92
FLIGHT = ("--config", "room", "--seed", "4", "--duration", "40", "--set", "link.blackout=[[12, 15]]")


def main() -> None:
    """Fly, judge, draw."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "uavctl", "loopback", *FLIGHT, "--out", folder, "--json"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        flight = FlightData.from_records(read(Path(folder) / "flight.mcap"))
    for name, drawing in pictures(flight):
        (OUT / f"report-{name}.svg").write_text(make_standalone(drawing.svg, drawing.label), encoding="utf-8")
    (OUT / "quick-fly.svg").write_text(terminal("loopback", "--udp", "--config", "room"), encoding="utf-8")


def terminal(*command: str) -> str:
    """A command of `uavctl` and what it prints, as a picture of a terminal."""
    with tempfile.TemporaryDirectory() as folder:
        said = subprocess.run(
            [sys.executable, "-m", "uavctl", *command],
            check=True,
            capture_output=True,
            text=True,
            cwd=folder,
            env={**os.environ, "FORCE_COLOR": "1", "PYTHONPATH": str(OUT.parents[1])},
        )
    console = Console(record=True, width=WIDTH, file=StringIO(), force_terminal=True)
    console.print(Text(f"$ uavctl {' '.join(command)}", style="bold"))
    console.print(Text.from_ansi(said.stdout))
    svg = console.export_svg(title="uavctl", unique_id="terminal")
    return re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)  # a picture must not fetch anything


def pictures(flight: FlightData) -> Iterator[tuple[str, Drawing]]:
    """Name and drawing of each picture."""
    judged = judge_flight(flight)
    yield "timeline", next(draw_timeline(flight))
    yield from (("path", drawing) for drawing in draw_path_3d(flight))
    yield "axis", next(plots.draw_axes_over_time(flight))
    yield "age", figures.draw_age_figure(flight)
    yield "link", next(link_figures.draw_link_ages(flight, judged.verdicts.link))
    model = judged.verdicts.model
    if model is not None:
        yield "white", verdict_figures.draw_whiteness(model.axes[0])
        yield "ellipsoids", verdict_figures.draw_coverage(model.leads)


if __name__ == "__main__":
    main()
