"""The paper's scheme: arrays in, arrays out; no clock, no socket, no files."""
