"""uavctl: stochastic predictive flight control over links that lose packets.

The functions for Python (docs/python.md) are loaded when they are first asked for; `__init__.pyi` tells their types.
"""

from importlib import import_module

from uavctl.arithmetic import ARITHMETIC as ARITHMETIC  # first of all: numpy asks for it when it is loaded

__version__ = "0.2.0"
_MODULES = {
    "Config": "uavctl.config",
    "Flight": "uavctl.api.flights",
    "Recording": "uavctl.api.flights",
    "Runs": "uavctl.api.control",
    "SolvedPlan": "uavctl.api.control",
    "SteppedController": "uavctl.api.control",
    "controller": "uavctl.api.control",
    "fly": "uavctl.api.flights",
    "link": "uavctl.api.control",
    "load": "uavctl.api.control",
    "plant": "uavctl.api.control",
    "plot": "uavctl.api.figures",
    "presets": "uavctl.config",
    "read": "uavctl.api.flights",
    "simulate": "uavctl.api.control",
    "solve": "uavctl.api.control",
}
__all__ = tuple(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
