"""Somebody who looks at pages, and keeps what they complain of."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, BrowserContext, Page

from tests.web.served import PATIENCE_MS

__all__ = ["Visitor"]


@dataclass
class Visitor:
    """Opens pages, and keeps what they complain of."""

    browser: Browser
    url: str
    artefacts: Path | None
    complaints: list[str] = field(default_factory=list)
    expected: set[int | str] = field(default_factory=set)
    """What the test provokes and browsers log as errors: statuses, and names of network errors."""
    contexts: list[BrowserContext] = field(default_factory=list)

    def open(
        self, view: str = "#/", *, at: str | None = None, script: str = "", **options: Any
    ) -> Page:
        """Open a view in a fresh context; `script` runs before the page's own."""
        context = self.browser.new_context(
            **{"reduced_motion": "reduce", "viewport": {"width": 1280, "height": 900}} | options
        )
        self.contexts.append(context)
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        if script:
            page.add_init_script(script)
        page.on("console", self._note)
        page.on("pageerror", lambda error: self.complaints.append(f"uncaught: {error}"))
        page.goto(f"{at or self.url}/{view}")
        page.locator("h1").wait_for()
        return page

    def shoot(self, page: Page, name: str) -> None:
        """Keep a screenshot of the whole page, or of the window if a dialog lies over it.

        Only where STILLPATH_ARTEFACTS asks for them: they take much of the time.
        """
        if self.artefacts is None:
            return
        whole = page.locator("dialog[open]").count() == 0
        page.screenshot(path=self.artefacts / f"{name}.png", full_page=whole)

    def _note(self, message: Any) -> None:
        if message.type not in ("error", "warning"):
            return
        found = re.search(r"the server responded with a status of (\d+)|net::(\w+)", message.text)
        cause = None if found is None else found[2] or int(found[1])
        if cause not in self.expected:
            self.complaints.append(f"{message.type}: {message.text}")
