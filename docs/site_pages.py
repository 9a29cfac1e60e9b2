"""Hooks of the documentation site (mkdocs.yml): pages made of the program itself at build time.

So the reference of commands, requests and report fields cannot lag behind. Pages whose source lies
outside of docs/ (CONTRIBUTING.md, CHANGELOG.md) are taken over with their links turned.
"""

from __future__ import annotations

import json
import os
import posixpath
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

__all__ = ["GENERATED", "on_files", "on_page_markdown", "on_post_page", "on_post_template"]

ROOT = Path(__file__).resolve().parents[1]
_TAKEN_OVER = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}
"""From a file of the root to its page."""
_LINK = re.compile(r"(?<!!)\[([^\]\n]*)\]\(([^)\s]+)\)")
_MADE = "Made from the program when this site was built."
_PIPE_IN_CODE = re.compile(r"`([^`\n]*\\\|[^`\n]*)`")
"""In tables GitHub drops the backslash, Python-Markdown does not."""
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; worker-src 'self'; font-src 'self'; "
    "manifest-src 'self'; base-uri 'self'; form-action 'none'"
)
"""A page of the site loads nothing from another host, whatever the theme would like to."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is not a file in docs/."""
    from mkdocs.structure.files import File

    sys.path[:0] = [str(ROOT)] if str(ROOT) not in sys.path else []
    for name, make in GENERATED.items():
        files.append(File.generated(config, name, content=make()))
    for source, name in _TAKEN_OVER.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text()))
    icon = (ROOT / "service" / "web" / "icon.svg").read_text()
    files.append(File.generated(config, "images/icon.svg", content=icon))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Turn links that leave docs/: to their page, or, where there is none, into plain words."""
    name = page.file.src_uri
    here = posixpath.dirname(posixpath.join("docs", name))
    from_root = name in _TAKEN_OVER.values()

    def turned(found: re.Match[str]) -> str:
        text, link = found[1], found[2]
        if re.match(r"[a-z]+:|#", link):
            return found[0]
        path, mark, anchor = link.partition("#")
        target = posixpath.normpath(posixpath.join("" if from_root else here, path))
        target = "docs/" + _TAKEN_OVER[target] if target in _TAKEN_OVER else target
        if not target.startswith("docs/"):
            return text
        return f"[{text}]({posixpath.relpath(target, here)}{mark}{anchor})"

    return _PIPE_IN_CODE.sub(_unescaped, _LINK.sub(turned, markdown))


def _unescaped(code: re.Match[str]) -> str:
    return _code(code[1].replace("\\|", "|"))


def on_post_page(output: str, **_: Any) -> str:
    """Give every page a content security policy."""
    meta = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    return output.replace("<head>", f"<head>\n      {meta}", 1)


def on_post_template(output: str, **_: Any) -> str:
    """Give the page for wrong addresses the same; it is made of a template alone."""
    return on_post_page(output)


def commands_page() -> str:
    """Return every command of `stillpath` with its options, and the help of `stillpath-post`."""
    from typer.main import get_command

    from stillpath.cli.main import app

    parts = [
        "# Every command and option",
        f"{_MADE} What the commands are for: [command line](../cli.md).",
    ]
    root = get_command(app)
    root_context = root.make_context("stillpath", [], resilient_parsing=True)
    parts += _described(root, root_context)
    posting = subprocess.run(
        [sys.executable, ROOT / "integrations" / "slicers" / "stillpath_post.py", "--help"],
        check=True, capture_output=True, text=True, env=os.environ | {"COLUMNS": "96"},
    ).stdout  # fmt: skip
    posting = posting.replace("stillpath_post.py", "stillpath-post").replace(str(Path.home()), "~")
    parts += ["## stillpath-post", f"```text\n{posting.strip()}\n```"]
    return "\n\n".join(parts) + "\n"


def _described(group: Any, context: Any) -> Iterator[str]:
    for name in sorted(getattr(group, "commands", {})):
        command = group.commands[name]
        if command.hidden:
            continue
        inner = type(context)(command, info_name=name, parent=context)
        path = inner.command_path
        yield f"{'##' if path.count(' ') == 1 else '###'} {path}"
        pieces = " ".join(command.collect_usage_pieces(inner))
        yield f"```text\n{path} {pieces}\n```"
        if command.help:
            yield _plain(command.help.strip())
        records = [p.get_help_record(inner) for p in command.get_params(inner)]
        rows = [f"| {_code(r[0])} | {_cell(r[1])} |" for r in records if r and "--help" not in r[0]]
        if rows:
            yield "\n".join(["| option | |", "|---|---|", *rows])
        yield from _described(command, inner)


def requests_page() -> str:
    """Return every request of the HTTP service, from its OpenAPI description."""
    document = _openapi()
    parts = [
        "# Every request",
        f"{_MADE} How to use them: [HTTP](../http.md).",
        "[openapi.json](openapi.json) has the schemas too; a running service serves it.",
    ]
    by_tag: dict[str, list[str]] = {}
    for path, methods in document["paths"].items():
        for method, said in methods.items():
            tag = (said.get("tags") or ["other"])[0]
            by_tag.setdefault(tag, []).append(_request(method.upper(), path, said))
    for tag, requests in by_tag.items():
        parts += [f"## {tag[0].upper()}{tag[1:]}", *requests]
    return "\n\n".join(parts) + "\n"


def _request(method: str, path: str, said: dict[str, Any]) -> str:
    parts = [f"### {method} {path}".replace("{", "\\{"), _plain(said.get("summary", ""))]
    if said.get("description"):
        parts.append(_plain(said["description"]))
    rows = [
        f"| {_code(p['name'])} | {p['in']} | {_cell(_kind(p.get('schema', {})))} "
        f"| {_cell(p.get('description', p.get('schema', {}).get('description', '')))} |"
        for p in said.get("parameters", [])
    ]
    if rows:
        parts.append("\n".join(["| parameter | in | type | |", "|---|---|---|---|", *rows]))
    if "requestBody" in said:
        kinds = ", ".join(f"`{kind}`" for kind in said["requestBody"]["content"])
        parts.append(f"Body: {kinds}")
    answers = [f"{code} {_cell(a['description'])}" for code, a in said["responses"].items()]
    parts.append("Answers: " + "; ".join(answers))
    return "\n\n".join(p for p in parts if p)


def openapi_file() -> str:
    """Return the description of the HTTP service as JSON."""
    return json.dumps(_openapi(), indent=1, ensure_ascii=False)


def _openapi() -> dict[str, Any]:
    from stillpath.service.api.app import create_app
    from stillpath.service.settings import Settings

    with tempfile.TemporaryDirectory() as folder:
        document: dict[str, Any] = create_app(Settings(data_dir=Path(folder))).openapi()
    return document


def report_page() -> str:
    """Return the fields of report.json, from its schema."""
    schema = json.loads((ROOT / "docs" / "report.schema.json").read_text())
    parts = [
        "# Fields of report.json",
        f"{_MADE} The schema: [report.schema.json](../report.schema.json).",
        _fields(schema),
    ]
    for name, part in schema["$defs"].items():
        parts += [f"## {name}", _plain(part.get("description", "").split("\n\n")[0]), _fields(part)]
    return "\n\n".join(p for p in parts if p) + "\n"


def _fields(schema: dict[str, Any]) -> str:
    rows = [
        f"| {_code(name)} | {_cell(_kind(said))} | {_cell(said.get('description', ''))} |"
        for name, said in schema["properties"].items()
    ]
    return "\n".join(["| field | type | |", "|---|---|---|", *rows])


def _kind(schema: dict[str, Any]) -> str:
    """Return a type in words."""
    if "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[-1]
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(_kind(s) for s in schema["anyOf"]))
    if "enum" in schema:
        return ", ".join(str(value) for value in schema["enum"])
    if schema.get("type") == "array":
        return f"list of {_kind(schema.get('items', {}))}"
    if isinstance(schema.get("additionalProperties"), dict):
        return f"map to {_kind(schema['additionalProperties'])}"
    return str(schema.get("const", schema.get("type", "any")))


def _code(text: str) -> str:
    return "<code>" + _escaped(text).replace("_", "\\_").replace("*", "\\*") + "</code>"


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", _plain(text))


def _plain(text: str) -> str:
    """Escape what would be Markdown or HTML, outside of backticks."""
    pieces = re.split(r"(`[^`\n]*`)", text)
    return "".join(
        p.replace("|", "&#124;")
        if p.startswith("`") and "|" not in p
        else _code(p.strip("`"))
        if p.startswith("`")
        else re.sub(r"([*_\[\]])", r"\\\1", _escaped(p))
        for p in pieces
    )


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("|", "&#124;")


GENERATED: dict[str, Callable[[], str]] = {
    "reference/commands.md": commands_page,
    "reference/requests.md": requests_page,
    "reference/report.md": report_page,
    "reference/openapi.json": openapi_file,
}
"""Files of the site that are made, by name."""
