"""pymavlink's FTP client, which has types of its own that are not complete."""

from typing import Any

def __getattr__(name: str) -> Any: ...
