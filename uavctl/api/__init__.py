"""Functions for Python, reached as `uavctl.load`, `uavctl.solve` and so on; docs/python.md shows them."""

from importlib.util import find_spec
from pathlib import Path

from uavctl.errors import UsageError

_HOME = Path(__file__).parents[2]


def _find_siblings() -> None:
    """See that `sim` and `logs`, names that anybody may give a module, are those installed with this package.

    Raises:
        UsageError: Another module hides one of them.
    """
    for name in ("sim", "logs"):
        found = find_spec(name)
        where = None if found is None or found.origin is None else Path(found.origin)
        if where is None or where.resolve().parents[1] != _HOME.resolve():
            raise UsageError(
                f"module {name} is {where or 'missing'}, not the one of uavctl in {_HOME}; "
                "rename it, or start Python in another folder"
            )


_find_siblings()
