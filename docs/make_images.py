"""Make the pictures of the documentation anew: `python docs/make_images.py [--work FOLDER]`.

Figures (SVG) are drawn from what the programs compute and from the tables of docs/benchmarks.md;
screenshots (WebP) show our own page and our own reports, in Debian's Chromium. What was computed
stays in the folder and is used again. Needs the dependency groups `docs` and `test`; some minutes.

The screenshots of slicers are made by docs/make_slicer_images.sh.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from stillpath.reports.charts import Chart, Line, draw  # noqa: E402

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

IMAGES = ROOT / "docs" / "images"
MOST_BYTES = 150_000
"""Of one picture."""
PATIENCE_MS = 240_000
GEAR = ROOT / "examples" / "cura_ender3_gear24.gcode"
REPORTS = {
    "gear-ender3": (GEAR, "ender3", []),
    "gear-voron-v0": (GEAR, "voron-v0", []),
    "gear-ender3-shaper": (GEAR, "ender3", ["--method", "shaper:mzv"]),
    "gear-ender3-advise": (GEAR, "ender3", ["--method", "advise", "--budget-um", "25"]),
}
"""Reports of the gallery, by name: file, machine, options."""
MEASURED = {"x": (52.3, 0.045), "y": (34.6, 0.06)}
"""Frequency and damping of the printer that the tutorial measures."""
PRINTER_CFG = """\
[printer]
kinematics: cartesian
max_velocity: 300
max_accel: 3000
max_z_velocity: 5
max_z_accel: 100
square_corner_velocity: 5.0
[stepper_x]
position_max: 235
[stepper_y]
position_max: 235
[stepper_z]
position_max: 250
[extruder]
pressure_advance: 0.04
nozzle_diameter: 0.400
filament_diameter: 1.750
max_extrude_cross_section: 5
[input_shaper]
shaper_type: mzv
shaper_freq_x: 52.0
shaper_freq_y: 34.2
"""
STYLE = (
    "text{fill:#4a5559;font:12px system-ui,'Liberation Sans',sans-serif}"
    "text.small{font-size:10px}text.title{fill:#16262a;font-weight:600}"
    "line{stroke:#e2e8ea}path{fill:none;stroke-width:1.8;stroke-linejoin:round}"
    ".plan{stroke:#16262a}.before{stroke:#c2571a}.shaper{stroke:#7a6cc4}.after{stroke:#0b7f88}"
    ".soft{stroke:#9aa7ab}.lead{stroke-width:.8;opacity:.7}.dashed{stroke-dasharray:7 4}"
    "rect.before{fill:#d98a5c;stroke:none}rect.shaper{fill:#a39ad8;stroke:none}"
    "rect.after{fill:#0b7f88;stroke:none}"
)


def main() -> None:
    """Make all of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="keep what was computed here")
    parser.add_argument("--only", choices=["figures", "screenshots"])
    given = parser.parse_args()
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        work = (given.work or Path(folder)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        if given.only != "screenshots":
            figures(work)
        if given.only != "figures":
            screenshots(work)
    for path in sorted(IMAGES.iterdir()):
        print(f"{path.stat().st_size:8d}  {path.name}")


def figures(work: Path) -> None:
    """Draw the figures of docs/figures.md."""
    kept = work / "gear.npz"
    _once(kept, "trajectories", GEAR, "--machine", "ender3", "-o", kept, "--from", 120, "--to", 150)
    design = _design(work)
    with np.load(kept) as file:
        motion = {name: np.asarray(file[name]) for name in file}
    worst = int(np.argmax(np.where(motion["extruding"] > 0, motion["before_contour_um"], 0.0)))
    _write("corner.svg", corner(motion, worst))
    _write("counter.svg", counter_movement(motion, worst))
    _write("error.svg", error_over_time(motion, worst))
    _write("robustness.svg", robustness(json.loads((design / "design.json").read_text())))
    _write("printers.svg", printers((ROOT / "docs" / "benchmarks.md").read_text()))


def _design(work: Path) -> Path:
    """Return the folder of a design report."""
    folder = work / "design"
    _once(folder, "design", "--machine", "ender3", "--axis", "y", "--report", folder)
    return folder


def corner(motion: dict[str, Any], worst: int) -> str:
    """Return the way of the nozzle around the corner that rings most."""
    near = slice(max(worst - 90, 0), worst + 110)
    centre = motion["x_mm"][worst], motion["y_mm"][worst]
    width, height, half_mm = 720.0, 420.0, 1.1
    scale = height / (2 * half_mm)

    def path(x: str, y: str, style: str) -> str:
        at = [
            f"{width / 2 + (a - centre[0]) * scale:.1f} {height / 2 - (b - centre[1]) * scale:.1f}"
            for a, b in zip(motion[x][near], motion[y][near], strict=True)
        ]
        return f'<path class="{style}" d="M{"L".join(at)}"/>'

    lines = [
        ("as planned", "soft", "x_mm", "y_mm", 7.0),
        ("nozzle, as sliced", "before", "before_sim_x_mm", "before_sim_y_mm", 2.2),
        ("nozzle, compensated", "after", "after_sim_x_mm", "after_sim_y_mm", 2.2),
    ]
    out = [
        path(x, y, style).replace("<path", f'<path style="stroke-width:{w}"', 1)
        for _, style, x, y, w in lines
    ]
    for k, (name, style, *_) in enumerate(lines):
        y = 24 + 20 * k
        out.append(f'<path class="{style}" style="stroke-width:3" d="M14 {y}h28"/>')
        out.append(f'<text x="50" y="{y + 4}">{name}</text>')
    x = width - 20 - 0.5 * scale
    out.append(f'<path class="plan" d="M{x:.1f} {height - 22}h{0.5 * scale:.1f}"/>')
    out.append(f'<text x="{x:.1f}" y="{height - 30}">0.5 mm</text>')
    return _svg(width, height, "The nozzle's way around a corner", "".join(out))


def counter_movement(motion: dict[str, Any], worst: int) -> str:
    """Return how far command and nozzle are from the plan, in the axis that rings more."""
    near = slice(max(worst - 150, 0), worst + 350)
    off = {a: motion[f"before_sim_{a}_mm"][near] - motion[f"{a}_mm"][near] for a in ("x", "y")}
    axis = max(off, key=lambda a: float(np.abs(off[a]).max()))
    plan = motion[f"{axis}_mm"][near]
    command, answer = (motion[f"{name}_{axis}_mm"][near] for name in ("after", "after_sim"))
    t = (np.arange(len(plan)) - 150.0).tolist()
    chart = Chart(
        "Command and nozzle against the plan",
        "ms after the corner",
        f"µm from the plan, {axis.upper()}",
        [
            Line(t, _um(off[axis]), "before", "nozzle, as sliced"),
            Line(t, _um(command - plan), "plan dashed", "our command"),
            Line(t, _um(answer - plan), "after", "nozzle, compensated"),
        ],
    )
    return _drawn(chart)


def error_over_time(motion: dict[str, Any], worst: int) -> str:
    """Return the contour error over three seconds."""
    near = slice(max(worst - 1500, 0), worst + 1500)
    t = (motion["t_s"][near] - motion["t_s"][near][0]).tolist()
    chart = Chart(
        "Contour error over three seconds",
        "s",
        "contour error, µm",
        [
            Line(t, motion["before_contour_um"][near].tolist(), "before", "as sliced"),
            Line(t, motion["after_contour_um"][near].tolist(), "after", "compensated"),
        ],
    )
    return _drawn(chart)


def robustness(design: dict[str, Any]) -> str:
    """Return the error when the machine's frequencies are not the model's."""
    curves = {c["name"]: c for c in design["robustness"]["curves"]}
    shapers = [c for name, c in curves.items() if name.endswith(("zv", "ei"))]
    best = min(shapers, key=lambda c: float(c["nominal_um"]))
    shown = [
        (curves["none"], "before", "as planned"),
        (best, "shaper", f"shaper {best['label']}"),
        (curves["fbf-off"], "after", "nominal plant"),
        (curves["fbf-minimax"], "after dashed", "set, worst case"),
    ]
    percent = design["robustness"]["errors_percent"]
    chart = Chart(
        "Contour error against the error of the model",
        "error of the model's frequencies, %",
        "contour error rms, µm",
        [Line(percent, c["contour_um"], style, name) for c, style, name in shown],
        log=True,
    )
    return _drawn(chart)


def printers(benchmarks: str) -> str:
    """Return the first table of docs/benchmarks.md, at 2 um, as bars."""
    number = r"([\d.]+) \|"
    rows = re.findall(
        rf"^\| (\w+) \| ([\w-]+) \| 2 \| {number} {number} {number}", benchmarks, re.MULTILINE
    )
    machines = sorted({row[1] for row in rows})
    names = sorted({row[0] for row in rows})
    width, left, row_height, top = 720.0, 210.0, 11.0, 30.0
    largest = max(float(row[2]) for row in rows)
    scale = (width - left - 60) / largest
    out = []
    for k, (style, name) in enumerate(
        [("before", "as sliced"), ("shaper", "best-tuned shaper"), ("after", "Stillpath")]
    ):
        out.append(f'<rect class="{style}" x="{left + 150 * k}" y="4" width="12" height="12"/>')
        out.append(f'<text x="{left + 150 * k + 18}" y="14">{name}</text>')
    y = top
    for machine in machines:
        y += 18
        out.append(f'<text class="title" x="0" y="{y}">{machine}</text>')
        y += 8
        for name in names:
            found = next(row for row in rows if row[:2] == (name, machine))
            out.append(f'<text x="{left - 8}" y="{y + 21}" text-anchor="end">{name}</text>')
            for style, value in zip(("before", "shaper", "after"), found[2:], strict=True):
                long = float(value) * scale
                out.append(
                    f'<rect class="{style}" x="{left}" y="{y:.1f}" width="{long:.1f}" height="9"/>'
                    f'<text class="small" x="{left + long + 5:.1f}" y="{y + 9:.1f}">{value}</text>'
                )
                y += row_height
            y += 6
    y += 16
    out.append(f'<text x="{left}" y="{y}">contour error while extruding, rms, µm</text>')
    return _svg(width, y + 10, "Contour error on four printers and three files", "".join(out))


def tutorial(folder: Path) -> None:
    """Go the way of docs/tutorials/bed-slinger.md: measurement, machine, model, file."""
    from stillpath.models.identification.synthetic import simulate_log, write_raw_data
    from stillpath.models.identification.types import Excitation
    from stillpath.models.plants import PairsSpec, PolePair

    folder.mkdir(exist_ok=True)
    (folder / "printer.cfg").write_text(PRINTER_CFG)
    plants = {
        axis: PairsSpec(poles=(PolePair(f_hz=f_hz, zeta=zeta),))
        for axis, (f_hz, zeta) in MEASURED.items()
    }
    for k, (axis, direction) in enumerate({"x": (1.0, 0.0), "y": (0.0, 1.0)}.items()):
        if not list(folder.glob(f"raw_data_{axis}_*")):
            log = simulate_log(plants, Excitation(direction), rng=np.random.default_rng(k))
            write_raw_data(log, folder, f"20261120_18{10 + 5 * k}00")
    logs = sorted(folder.glob("raw_data_*"))
    fit, report, data = (folder / name for name in ("fit", "report", "data"))
    _once(data, "machines", "from-config", folder / "printer.cfg", "--name", "mine", data_dir=data)
    _once(fit, "identify", *logs, "--machine", "mine", "--report", fit, data_dir=data)
    out = folder / "gear.stillpath.gcode"
    compensate = ["compensate", GEAR, "-o", out, "-m", "mine", "--report", report]
    _once(report, *compensate, data_dir=data)


def screenshots(work: Path) -> None:
    """Shoot our page and our reports."""
    from playwright.sync_api import sync_playwright

    from tests.web.served import running

    for name, (source, machine, options) in REPORTS.items():
        folder = work / name
        out = work / f"{name}.gcode"
        _once(folder, "compensate", source, "-o", out, "-m", machine, "--report", folder, *options)
    tutorial(work / "tutorial")
    browser_path = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=browser_path,
            args=["--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        for name in REPORTS:
            page = _opened(browser, (work / name / "report.html").as_uri(), height=1780)
            _shoot(page, f"report-{name}.webp")
        report = work / "tutorial" / "report" / "report.html"
        _shoot(_opened(browser, report.as_uri(), height=1000), "report-tutorial.webp")
        fit = work / "tutorial" / "fit" / "identification.html"
        _shoot(_opened(browser, fit.as_uri(), height=1000), "identification.webp")
        page = _opened(browser, (_design(work) / "design.html").as_uri(), height=1200)
        _shoot(page, "design.webp")
        with running(work / "service") as service:
            page = _opened(browser, f"{service.url}/#/", height=860)
            page.get_by_role("button", name="Compensate").wait_for()
            page.wait_for_timeout(1500)  # what is loaded late settles
            _shoot(page, "page-new-job.webp")
            job = service.finished(service.submit(GEAR.read_bytes(), GEAR.name))
            page = _opened(browser, f"{service.url}/#/jobs/{job['id']}", height=1100)
            page.locator(".stage[data-renderer]:not([aria-busy])").wait_for(timeout=PATIENCE_MS)
            _shoot(page, "page-job.webp")
            page.locator(".stage").scroll_into_view_if_needed()
            _shoot(page, "page-layers.webp", page.locator(".stage"))
            page = _opened(browser, f"{service.url}/#/machines/ender3", height=1100)
            page.get_by_role("heading", name="Frequency response").wait_for()
            page.wait_for_timeout(3000)
            _shoot(page, "page-machine.webp")
        browser.close()


def _opened(browser: Browser, address: str, height: int) -> Page:
    page = browser.new_page(
        viewport={"width": 1100, "height": height}, color_scheme="light", reduced_motion="reduce"
    )
    page.set_default_timeout(PATIENCE_MS)
    page.goto(address)
    return page


def _shoot(page: Page, name: str, part: Any = None) -> None:
    picture = Image.open(io.BytesIO((part or page).screenshot())).convert("RGB")
    for quality in (80, 65, 50, 35):
        picture.save(IMAGES / name, "WEBP", quality=quality, method=6)
        if (IMAGES / name).stat().st_size < MOST_BYTES:
            return
    raise SystemExit(f"{name} is larger than {MOST_BYTES} bytes")


def _once(made: Path, *arguments: object, data_dir: Path | None = None) -> None:
    """Run `stillpath` if what it makes is not there yet."""
    if made.exists():
        return
    code = "from stillpath.cli.main import main; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    own = {} if data_dir is None else {"STILLPATH_DATA_DIR": str(data_dir)}
    subprocess.run(command, check=True, cwd=ROOT, env=os.environ | own)


def _um(values: Any) -> Sequence[float]:
    rounded: list[float] = np.round(values * 1e3, 2).tolist()
    return rounded


def _drawn(chart: Chart) -> str:
    width, height = 720.0, 320.0
    size = f'xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}"'
    drawn = draw(chart, width, height).replace("<svg ", f"<svg {size} ", 1)
    return drawn.replace(">", f"><style>{STYLE}</style>", 1)


def _svg(width: float, height: float, about: str, content: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
        f'viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{about}">'
        f"<style>{STYLE}</style>{content}</svg>"
    )


def _write(name: str, text: str) -> None:
    (IMAGES / name).write_text(text + "\n")


if __name__ == "__main__":
    main()
