"""Files that hold G-code in something else: binary G-code and sliced 3MF packages."""

from gcode.containers.opening import Container, open_text, rewriting
from gcode.containers.sniff import Kind, sniff

__all__ = ["Container", "Kind", "open_text", "rewriting", "sniff"]
