"""Configuration: TOML in, typed and checked values out."""

from uavctl.config.types import Config

__all__ = ["Config"]
