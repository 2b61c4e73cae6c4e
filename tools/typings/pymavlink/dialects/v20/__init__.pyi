"""Stubs of the dialects in use."""
