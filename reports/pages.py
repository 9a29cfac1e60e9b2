"""Static pages: a template of the package that asks, the house's style, and a content policy.

A page names the hash of its own style and forbids all else, so that a name from a file can never
become code.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import math
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path

from jinja2 import Environment, StrictUndefined, Template

from stillpath.pipeline.files import replacing

__all__ = ["asset", "content_hash", "rendered", "style_of", "thousands", "um_text", "write_texts"]


def write_texts(directory: Path, texts: Mapping[str, str]) -> None:
    """Write files into a folder, made if need be, each whole or not at all.

    Raises
    ------
    OSError
        If the folder or a file cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        with replacing(directory / name) as path:
            path.write_text(text, encoding="utf-8", newline="\n")


def style_of(*own: tuple[str, str]) -> str:
    """Return the style of a page without script, followed by the page's own.

    Parameters
    ----------
    own : tuples of (package, file)
    """
    shared = ((__package__, "report.css"), (__package__, "static.css"))
    return "".join(asset(package, name) for package, name in (*shared, *own))


def rendered(
    package: str,
    template: str,
    style: str,
    filters: Mapping[str, Callable[..., str]],
    **values: object,
) -> str:
    """Return a page.

    Parameters
    ----------
    package, template : str
        Where the Jinja template lies.
    style : str
        CSS; the template finds it as `style` and its hash as `style_hash`.
    **values
        Names of the template; a missing one is an error.
    """
    page = _compiled(package, template, tuple(filters.items()))
    return page.render(style=style, style_hash=content_hash(style), **values)


def um_text(value: float | None) -> str:
    """Return micrometres with three significant digits at most, as `lib/format.js` shows them."""
    if value is None or not math.isfinite(value):
        return "–"
    if value >= 99.95:
        return thousands(value)
    return f"{value:.1f}" if value >= 9.995 else f"{value:.2f}"


def thousands(value: float) -> str:
    """Return a whole number with a thin no-break space between thousands, as SI writes them."""
    return f"{value:,.0f}".replace(",", "\u202f")


def content_hash(text: str) -> str:
    """Return the hash of a style or script as a content security policy writes it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def asset(package: str, name: str) -> str:
    """Return a text file of a package."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


@functools.cache  # compiling takes as long as the rest of a page
def _compiled(
    package: str, template: str, filters: tuple[tuple[str, Callable[..., str]], ...]
) -> Template:
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(filters)
    return environment.from_string(asset(package, template))
