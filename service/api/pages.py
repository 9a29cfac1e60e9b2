"""Serves the web page: files of the package, under addresses that name their content.

Every file lies below ``/assets/VERSION/``, and VERSION is a digest of all of them: browsers may
keep what they have fetched for good, and a new version has new addresses. Only the page itself is
asked for each time.
"""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import resources
from importlib.resources.abc import Traversable

from fastapi import APIRouter, Request
from jinja2 import Environment, FunctionLoader, StrictUndefined
from starlette.responses import Response

from stillpath.reports.pages import asset
from stillpath.service.api.file_responses import matches
from stillpath.service.api.problems import Problem

__all__ = ["PageFile", "WebPage", "answer", "framed", "page_files", "router"]

_PACKAGE = "stillpath.service.web"
_INDEX = "index.html"
_TYPES = {
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "svg": "image/svg+xml",
}
# Scripts and styles are files of this service; nothing is fetched from anywhere else. Blobs are
# downloads that needed a key.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
_SAFETY = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
}
_FOR_GOOD = "public, max-age=31536000, immutable"
_ASK_FIRST = "no-cache"

router = APIRouter(include_in_schema=False)


@dataclass(frozen=True)
class PageFile:
    """A file as it is sent."""

    content: bytes
    media_type: str

    @cached_property
    def etag(self) -> str:
        """Entity tag of the content."""
        return f'"{hashlib.sha256(self.content).hexdigest()[:16]}"'

    @cached_property
    def packed(self) -> bytes:
        """The content with gzip; the same bytes every time."""
        return gzip.compress(self.content, mtime=0)


@dataclass(frozen=True)
class WebPage:
    """The files that the page needs, by their paths."""

    version: str
    files: dict[str, PageFile]


@lru_cache(maxsize=1)
def page_files() -> WebPage:
    """Return the files of the page, read once by each process."""
    contents = dict(sorted(_walk(resources.files(_PACKAGE), "")))
    del contents[_INDEX]  # a template
    digest = hashlib.sha256()
    for path, content in contents.items():
        digest.update(f"{path}\0{len(content)}\0".encode() + content)
    version = digest.hexdigest()[:12]
    return WebPage(
        version=version,
        files={
            path: PageFile(content, _TYPES[_suffix(path)]) for path, content in contents.items()
        },
    )


@router.api_route("/", methods=["GET", "HEAD"])
def read_page(request: Request) -> Response:
    """Return the page."""
    return answer(request, _index())


@router.api_route("/assets/{version}/{path:path}", methods=["GET", "HEAD"])
def read_asset(request: Request, version: str, path: str) -> Response:
    """Return a file of the page.

    The address of another version is answered too: while services are renewed one by one, a page
    of the one may ask the other.
    """
    page = page_files()
    file = page.files.get(path)
    if file is None:
        raise Problem(404, "Not Found", f"The page has no file {path[:100]!r}; reload it.")
    return answer(request, file, _FOR_GOOD if version == page.version else _ASK_FIRST)


def framed(template: str, root: str, **values: object) -> PageFile:
    """Return a page of a template that extends the page's frame.

    Parameters
    ----------
    template : str
        Its name in `service/web`.
    root : str
        The way from the page's address to that of the service: ``../``.
    **values
        Names of the template; a missing one is an error.
    """
    environment = Environment(
        loader=FunctionLoader(lambda name: asset(_PACKAGE, name)),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template(template)
    assets = f"{root}assets/{page_files().version}"
    return PageFile(page.render(root=root, assets=assets, **values).encode(), _TYPES["html"])


@lru_cache(maxsize=1)
def _index() -> PageFile:
    return framed(_INDEX, "")


def answer(request: Request, file: PageFile, caching: str = _ASK_FIRST) -> Response:
    """Return a file with the headers of the page: packed, or 304, if the caller wants that."""
    headers = {**_SAFETY, "ETag": file.etag, "Cache-Control": caching, "Vary": "Accept-Encoding"}
    if matches(request.headers.get("if-none-match"), file.etag):
        return Response(status_code=304, headers=headers)
    content = file.content
    if _takes_gzip(request.headers.get("accept-encoding", "")):
        content, headers["Content-Encoding"] = file.packed, "gzip"
    return Response(content, media_type=file.media_type, headers=headers)


def _takes_gzip(header: str) -> bool:
    """Return whether Accept-Encoding names gzip, and not with a weight of 0 (RFC 9110, 12.5.3)."""
    for part in header.split(","):
        name, _, weight = part.partition(";")
        if name.strip().lower() == "gzip":
            return weight.replace(" ", "").lower() not in ("q=0", "q=0.0", "q=0.00", "q=0.000")
    return False


def _walk(folder: Traversable, prefix: str) -> list[tuple[str, bytes]]:
    """Return path and content of what is served; notes and licences are not."""
    found: list[tuple[str, bytes]] = []
    for entry in folder.iterdir():
        path = f"{prefix}{entry.name}"
        if entry.is_dir():
            found += _walk(entry, f"{path}/")
        elif _suffix(path) in _TYPES:
            found.append((path, entry.read_bytes()))
    return found


def _suffix(path: str) -> str:
    return path.rpartition(".")[2]
