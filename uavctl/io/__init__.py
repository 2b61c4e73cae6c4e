"""Sockets, serial ports and cameras: where bytes come in and go out."""
