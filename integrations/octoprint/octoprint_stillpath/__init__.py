"""Stillpath as a plugin of OctoPrint: what is uploaded is compensated into a second file.

Set-up and behaviour: docs/octoprint.md of Stillpath.
"""

from __future__ import annotations

import contextlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import flask
import octoprint.plugin
from octoprint.access.permissions import Permissions
from octoprint.events import Events
from octoprint.filemanager import FileDestinations

from .choices import (
    DEFAULTS,
    METHODS,
    ROBUST,
    is_result,
    is_stamped,
    is_taken,
    machine_for,
    options_of,
)
from .client import Failure
from .compensators import OnServer
from .hosting import OctoPrintHost
from .ledger import Entry, Ledger
from .reports import Reports
from .worker import Worker

__all__ = ["StillpathPlugin"]

# Scripts of a report run, but without the rights of OctoPrint's own pages.
_REPORT_POLICY = "sandbox allow-scripts allow-popups allow-downloads"


class StillpathPlugin(
    octoprint.plugin.StartupPlugin,
    octoprint.plugin.ShutdownPlugin,
    octoprint.plugin.SettingsPlugin,
    octoprint.plugin.EventHandlerPlugin,
    octoprint.plugin.SimpleApiPlugin,
    octoprint.plugin.BlueprintPlugin,
    octoprint.plugin.AssetPlugin,
    octoprint.plugin.TemplatePlugin,
):
    """Takes uploads, lets the worker compensate them, and shows how it goes."""

    # Life

    def initialize(self) -> None:
        """Read what an earlier run has left; files may come before all of OctoPrint is there."""
        folder = Path(self.get_plugin_data_folder())
        self._ledger = Ledger(folder / "files.json")
        self._reports = Reports(folder / "reports")
        self._host = OctoPrintHost(self, self._ledger, self._reports, self._show)
        for entry in self._ledger.open():
            self._logger.info("%s is taken up again", entry.path)
            self._ledger.disarm(entry, "OctoPrint was restarted meanwhile")
        self._worker = Worker(self._ledger, self._host, folder / "work", self._logger)

    def on_after_startup(self) -> None:
        """Go on with what was interrupted."""
        try:
            self._host.sweep()
        except Exception:  # old pages are no reason not to work
            self._logger.exception("reports cannot be tidied up")
        self._worker.start()

    def on_shutdown(self) -> None:
        """Leave what is under way to the next start."""
        self._worker.stop()

    # Settings

    def get_settings_defaults(self) -> dict[str, Any]:
        """Return all settings as they are at first."""
        return dict(DEFAULTS)

    def get_settings_restricted_paths(self) -> dict[str, list[list[str]]]:
        """Show the key to nobody but those who may change it."""
        return {"admin": [["key"], ["server"], ["command"]]}

    # Files

    def on_event(self, event: str, payload: dict[str, Any]) -> None:
        """Take what is uploaded; stop what is deleted; do not print onto a print."""
        if event == Events.PRINT_STARTED:
            for entry in self._ledger.open():
                self._ledger.disarm(entry, "another print began meanwhile")
        elif payload and payload.get("storage") == FileDestinations.LOCAL:
            operation, path = payload.get("operation"), payload.get("path")
            if event == Events.FILE_ADDED and operation == "add":
                self._uploaded(path)
            elif event == Events.FILE_REMOVED and operation == "remove":
                self._give_up(path)

    def _uploaded(self, path: str) -> None:
        """Take a file, unless it is one that is left alone in silence."""
        source = self._host.disk_path(path)
        # OctoPrint tells of a file some time after it came: it may have been asked for meanwhile.
        version = _version(source)
        if any(entry.path == path and entry.version == version for entry in self._ledger.open()):
            return
        self._give_up(path)
        if not self._settings.get_boolean(["automatic"]) or not is_taken(path) or is_result(path):
            return
        if source is not None and not is_stamped(source):
            self._take(path)

    def _take(self, path: str) -> Entry:
        """Put a file on the list; what is wrong with the settings is an entry's failure."""
        settings = {name: self._settings.get([name]) for name in DEFAULTS}
        profile = str(self._printer_profile_manager.get_current_or_default().get("name") or "")
        entry = Entry(path, "", {}, where=str(settings.get("where")))
        entry.version = _version(self._host.disk_path(path))
        try:
            entry.server = str(settings.get("server") or "").strip()
            rows = settings.get("machines") or []
            entry.machine = machine_for(profile, rows, str(settings.get("machine") or ""))
            entry.options = options_of(settings)
            entry.print_after = self._settings.get_boolean(["print_after"])
            if not entry.machine:
                raise Failure(
                    f'no machine is set for the printer profile "{profile}"; choose one in the '
                    "settings of Stillpath"
                )
        except Failure as failure:
            entry.state, entry.message = "failed", str(failure)
        if not self._printer.is_ready():
            entry.disarm("the printer was not ready when the file came")
        self._ledger.add(entry)
        self._show(entry)
        return entry

    def _give_up(self, path: str) -> None:
        """Cancel what is under way for a file that is gone or was replaced."""
        for entry in self._ledger.open():
            if entry.path == path:
                self._ledger.cancel(entry)
                self._show(entry)

    # What people see

    def _show(self, entry: Entry) -> None:
        """Send the list to the pages; what has just ended is told beside it."""
        message = {"entries": self._views(), "ended": _view(entry) if entry.is_over else None}
        with contextlib.suppress(Exception):  # a page that went away is no trouble of the work
            self._plugin_manager.send_plugin_message(
                self._identifier, message, permissions=[Permissions.FILES_LIST]
            )

    def _views(self) -> list[dict[str, Any]]:
        return [_view(entry) for entry in reversed(self._ledger.entries())]

    def get_template_configs(self) -> list[dict[str, Any]]:
        """Return where our templates go."""
        listed = "visible: loginState.hasPermissionKo(access.permissions.FILES_LIST)"
        return [
            {"type": "settings", "name": "Stillpath", "custom_bindings": True},
            {"type": "navbar", "custom_bindings": True},
            {
                "type": "sidebar",
                "name": "Stillpath",
                "icon": "fas fa-bezier-curve",
                "custom_bindings": True,
                "data_bind": listed,
            },
        ]

    def get_template_vars(self) -> dict[str, Any]:
        """Return what templates name."""
        return {"methods": METHODS, "robust": ROBUST}

    def is_template_autoescaped(self) -> bool:
        """Texts are never pages."""
        return True

    def get_assets(self) -> dict[str, list[str]]:
        """Return what pages load."""
        return {"js": ["js/stillpath.js"], "css": ["css/stillpath.css"]}

    # API: /api/plugin/stillpath

    def is_api_protected(self) -> bool:
        """Somebody must be logged in."""
        return True

    def get_api_commands(self) -> dict[str, list[str]]:
        """Return the commands and what they need."""
        return {"process": ["path"], "cancel": ["id"], "forget": [], "machines": ["server"]}

    def on_api_get(self, request: Any) -> Any:  # noqa: ARG002
        """Return the list of files."""
        _require(Permissions.FILES_LIST)
        return flask.jsonify(entries=self._views())

    def on_api_command(self, command: str, data: dict[str, Any]) -> Any:
        """Do what a page or a script asks for."""
        if command == "machines":
            return self._list_machines(data)
        _require(Permissions.FILES_UPLOAD)
        if command == "process":
            return flask.jsonify(entry=_view(self._process(str(data["path"]))))
        if command == "cancel":
            entry = self._ledger.find(str(data["id"]))
            if entry is None or entry.is_over:
                flask.abort(409, description="there is nothing to cancel: it is over")
            self._ledger.cancel(entry)
            self._show(entry)
        elif command == "forget":
            self._ledger.forget()
        return flask.jsonify(entries=self._views())

    def _process(self, path: str) -> Entry:
        """Take a file because somebody asked for it, and say why not."""
        source = self._host.disk_path(path) if is_taken(path) else None
        if source is None:
            flask.abort(404, description=f"there is no G-code {path}")
        if is_stamped(source):
            flask.abort(
                409,
                description=f"{path} was already processed by Stillpath; compensate the original",
            )
        version = _version(source)
        for entry in self._ledger.open():
            same = entry.path == path and entry.version == version
            if same and not self._ledger.is_cancelled(entry):
                return entry
        self._give_up(path)  # of an earlier upload, or cancelled and not over yet
        return self._take(path)

    def _list_machines(self, data: dict[str, Any]) -> Any:
        """Return the machines of a server; the key that is stored is never sent for this."""
        _require(Permissions.SETTINGS)
        server = str(data["server"]).strip()
        key = str(data.get("key") or "").strip()
        probe = Entry("", "", {}, server=server)
        try:
            client = OnServer(probe, key, 10.0, lambda *_: None, lambda **_: None)
            return flask.jsonify(machines=client.machines())
        except Failure as failure:
            return flask.jsonify(machines=[], reason=str(failure))

    # Pages: /plugin/stillpath

    def is_blueprint_csrf_protected(self) -> bool:
        """Protect what may come later; reports are only read."""
        return True

    @octoprint.plugin.BlueprintPlugin.route("/reports/<string:report_id>", methods=["GET"])
    def report(self, report_id: str) -> Any:
        """Return the page of a report."""
        _require(Permissions.FILES_DOWNLOAD)
        path = self._reports.path(report_id)
        if path is None:
            flask.abort(404)
        answer = flask.send_file(str(path), mimetype="text/html")
        answer.headers["Content-Security-Policy"] = _REPORT_POLICY
        answer.headers["X-Content-Type-Options"] = "nosniff"
        return answer

    # Updates

    def get_update_information(self) -> dict[str, Any]:
        """Return where newer versions are found."""
        return {
            "stillpath": {
                "displayName": "Stillpath",
                "displayVersion": self._plugin_version,
                "type": "pypi_release",
                "package": "OctoPrint-Stillpath",
                "pip": "OctoPrint-Stillpath=={target_version}",
            }
        }


def _view(entry: Entry) -> dict[str, Any]:
    """Return an entry as pages show it."""
    shown = asdict(entry)
    for name in ("server", "is_ours", "tries", "begun", "version"):
        del shown[name]
    shown["is_over"] = entry.is_over
    return shown


def _version(source: Path | None) -> list[int]:
    """Return what tells one upload of a name from the next."""
    with contextlib.suppress(OSError):  # deleted meanwhile
        if source is not None:
            about = source.stat()
            return [about.st_size, about.st_mtime_ns]
    return []


def _require(permission: Any) -> None:
    if not permission.can():
        flask.abort(403)


__plugin_name__ = "Stillpath"
__plugin_pythoncompat__ = ">=3.8,<4"
__plugin_implementation__ = StillpathPlugin()
__plugin_hooks__ = {
    "octoprint.plugin.softwareupdate.check_config": __plugin_implementation__.get_update_information
}
