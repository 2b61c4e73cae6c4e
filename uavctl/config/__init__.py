"""Configuration: TOML in, typed and checked values out."""

from uavctl.config.load import Loaded, dump_config, explain, load, load_config, parse, presets
from uavctl.config.source import Source
from uavctl.config.types import Config

__all__ = ["Config", "Loaded", "Source", "dump_config", "explain", "load", "load_config", "parse", "presets"]
