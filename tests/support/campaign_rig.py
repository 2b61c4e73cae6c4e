"""Small campaigns on preset paper."""

from __future__ import annotations

from pathlib import Path

from uavctl.lab.campaign.spec import Campaign, read_campaign
from uavctl.lab.campaign.tasks import Cell, make_cells

HEAD = 'name = "small"\nconfig = "paper"\n'


def controller(kind: str, *more: str) -> str:
    return table("controller", kind, f'kind = "{kind}"', *more)


def table(of: str, name: str, *more: str) -> str:
    return "\n".join([f"[[{of}]]", f'name = "{name}"', *more, ""])


def read(folder: Path, *parts: str) -> Campaign:
    file = folder / "small.toml"
    file.write_text(HEAD + "".join(parts), encoding="utf-8")
    return read_campaign(file)[0]


def cells(folder: Path, *parts: str) -> tuple[Cell, ...]:
    return make_cells(read(folder, *parts))
