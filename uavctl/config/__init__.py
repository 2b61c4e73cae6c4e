"""Configuration: TOML in, typed and checked values out."""

from uavctl.config.document import Source
from uavctl.config.load import LoadedConfig, describe_design_error, dump_config, load, load_config, parse, presets
from uavctl.config.types import Config

__all__ = [
    "Config",
    "LoadedConfig",
    "Source",
    "describe_design_error",
    "dump_config",
    "load",
    "load_config",
    "parse",
    "presets",
]
