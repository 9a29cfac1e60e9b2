"""Serves the documentation: the Markdown files of docs/ as pages below ``/help/``.

Addresses are those of the files without ``.md``, so that the links of a text lead on as they are.
What is linked but not served, such as a file of the repository, is shown as plain words.
"""

from __future__ import annotations

import posixpath
import re
import unicodedata
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path

from fastapi import APIRouter, Request
from markdown_it import MarkdownIt
from markdown_it.token import Token
from starlette.responses import Response

from stillpath.service.api.pages import PageFile, answer, framed
from stillpath.service.api.problems import Problem

__all__ = ["help_names", "linked", "router", "slug"]

_DOCS = Path(__file__).resolve().parents[2] / "docs"
"""Beside the layers, in a checkout as in an installed package."""
_TYPES = {
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".webp": "image/webp",
}
_START = "index"
_PAGE_NAME = re.compile(r"\bdocs/([\w/-]+)\.md\b")
_SHOWN = re.compile(r">[^<]+")

# What the texts have beyond CommonMark and tables, as this page shows it.
_NOTE = re.compile(r'^!!! \w+ "(.*)"\n((?:(?:    .*)?\n)+)', re.MULTILINE)
_REPLACED = (
    (re.compile(r"^<!--.*-->\n", re.MULTILINE), ""),
    (re.compile(r"^</?(?:div|figure)\b.*>\n", re.MULTILINE), ""),
    (re.compile(r"^<figcaption>(.*)</figcaption>$", re.MULTILINE), r"\n*\1*"),
    (re.compile(r"(?<=\))\{ \.\w+ \}"), ""),
    (re.compile(r"^- \[ \] ", re.MULTILINE), "- ☐ "),
)
_CELLS = (
    # Wide ones are scrolled by themselves, also by keys.
    ("<table>", '<div class="scroll" tabindex="0"><table>'),
    ("</table>", "</table></div>"),
    ("<th></th>", "<td></td>"),
    ("<pre>", '<pre tabindex="0">'),
)

router = APIRouter(include_in_schema=False)


@dataclass
class _Text:
    """A page but for its frame."""

    title: str = ""
    body: str = ""
    """HTML."""
    headings: list[tuple[str, str]] = field(default_factory=list)
    """Id and words of the second level."""


@router.api_route("/help/{name:path}", methods=["GET", "HEAD"])
def read_help(request: Request, name: str) -> Response:
    """Return a page of the documentation, or one of its pictures."""
    name = name.removesuffix(".md") or _START
    if name not in _sources():
        raise Problem(
            404, "No such page", f"There is no help page {name[:100]!r}; /help/index has the list."
        )
    return answer(request, _file(name))


def help_names() -> list[str]:
    """Return the names of all pages: ``safety``, ``tutorials/docker``."""
    return [name for name, path in _sources().items() if path.suffix == ".md"]


def linked(page: str) -> str:
    """Return an HTML page of ``/v1/machines/NAME/``, in which the names of documents are links."""

    def link(found: re.Match[str]) -> str:
        if found[1] not in _sources():
            return found[0]
        return f'<a href="../../../help/{found[1]}">{found[0]}</a>'

    head, mark, body = page.partition("<body")
    return head + mark + _SHOWN.sub(lambda text: _PAGE_NAME.sub(link, text[0]), body)


def slug(words: str) -> str:
    """Return the id of a heading, as Python-Markdown's `slugify` has it on the site."""
    words = unicodedata.normalize("NFKD", words).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", words).strip().lower())


@cache
def _sources() -> dict[str, Path]:
    """Return the files by their names here; nothing else is ever opened."""
    found = {}
    for path in sorted(_DOCS.rglob("*")):
        name = path.relative_to(_DOCS).as_posix()
        if path.suffix == ".md":
            found[name.removesuffix(".md")] = path
        elif path.suffix in _TYPES:
            found[name] = path
    return found


@cache  # as many as there are files
def _file(name: str) -> PageFile:
    path = _sources()[name]
    if path.suffix != ".md":
        return PageFile(path.read_bytes(), _TYPES[path.suffix])
    text = _text(name)
    pages = sorted((_title(one), _way(name, one)) for one in help_names())
    root = "../" * (1 + name.count("/"))
    return framed("help.html.j2", root, text=text, pages=pages, start=_way(name, _START))


@cache
def _title(name: str) -> str:
    found = re.search(r"^# (.+)$", _sources()[name].read_text("utf-8"), re.MULTILINE)
    return found[1].replace("`", "") if found else name


def _text(name: str) -> _Text:
    """Return a page as HTML. The texts have no HTML of their own: what looks like it is escaped."""
    source = _NOTE.sub(_quoted, _sources()[name].read_text("utf-8"))
    for pattern, replacement in _REPLACED:
        source = pattern.sub(replacement, source)
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = markdown.parse(source)
    text = _Text(title=_title(name))
    used: dict[str, int] = {}
    for opening, inline in pairwise(tokens):
        if opening.type == "heading_open":
            words = _words(inline)
            anchor = slug(words)
            used[anchor] = used.get(anchor, -1) + 1
            anchor += f"_{used[anchor]}" if used[anchor] else ""
            opening.attrSet("id", anchor)
            if opening.tag == "h2":
                text.headings.append((anchor, words))
        if inline.type == "inline":
            _turn_links(name, inline.children or [])
    body = markdown.renderer.render(tokens, markdown.options, {})
    for plain, shown in _CELLS:
        body = body.replace(plain, shown)
    text.body = body
    return text


def _turn_links(name: str, tokens: list[Token]) -> None:
    """Make the links of a text lead to where this service has it, if it does."""
    is_served = True
    for token in tokens:
        if token.type == "link_open":
            target = _target(name, str(token.attrGet("href")))
            is_served = target is not None
            token.attrs = {} if target is None else {"href": target}
        if token.type in ("link_open", "link_close") and not is_served:
            token.tag = "span"


def _target(name: str, address: str) -> str | None:
    if re.match(r"https:|#", address):
        return address
    path, mark, anchor = address.partition("#")
    wanted = posixpath.normpath(posixpath.join(posixpath.dirname(name), path)).removesuffix(".md")
    return _way(name, wanted) + mark + anchor if wanted in _sources() else None


def _way(here: str, there: str) -> str:
    return posixpath.relpath(there, posixpath.dirname(here) or ".")


def _words(inline: Token) -> str:
    return "".join(token.content for token in inline.children or [])


def _quoted(note: re.Match[str]) -> str:
    lines = [f"**{note[1]}**", "", *(line[4:] for line in note[2].rstrip().split("\n"))]
    return "".join(f"> {line}".rstrip() + "\n" for line in lines) + "\n"
