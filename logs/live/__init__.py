"""Live view of a flight: a page for browsers and a WebSocket for Foxglove, in a process of its own."""
