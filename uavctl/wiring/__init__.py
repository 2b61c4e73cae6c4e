"""Composition: from a configuration to what flies."""
