"""Composition: from a configuration to the controller."""
