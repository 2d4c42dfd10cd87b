"""The report in a real browser: drawing, sorting, filtering, speed and an empty console."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from spn_data.inputs.thumbnails import MAX_BYTES
from spn_data.report.ground_texture import GroundTexture
from spn_data.report.html import render
from tests.worlds.report_data import area, pictures

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: chromium)"),
]

# Messages of the browser driver that do not come from the page.
HARMLESS = ("GL Driver Message",)

# Runs in the page after its own script and writes its measurements into the document.
PROBE = """<script>
const found = {};
const bytes = canvas => {
  const flat = document.createElement("canvas");
  flat.width = canvas.width; flat.height = canvas.height;
  flat.getContext("2d").drawImage(canvas, 0, 0);
  return flat.getContext("2d").getImageData(0, 0, flat.width, flat.height).data;
};
const countInView = isWanted => {
  window.spnReport.view.draw();
  const data = bytes(document.getElementById("view"));
  let n = 0;
  for (let k = 0; k < data.length; k += 4) n += isWanted(data[k], data[k + 1], data[k + 2]);
  return n;
};
const pixels = canvas => {
  const data = bytes(canvas);
  const colors = new Map();
  for (let k = 0; k < data.length; k += 4) {
    const color = data[k] << 16 | data[k + 1] << 8 | data[k + 2];
    colors.set(color, (colors.get(color) || 0) + 1);
  }
  const most = Math.max(...colors.values());
  return {colors: colors.size, drawn: 1 - most / (data.length / 4)};
};
const rows = () => [...document.querySelectorAll("#table tbody tr[data-row]")];
const column = k => rows().map(row => row.cells[k].textContent);
const heads = () => [...document.querySelectorAll("#table thead th")];
const report = () => {
  const out = document.createElement("pre");
  out.id = "found";
  out.textContent = JSON.stringify(found);
  window.top.document.body.append(out);
};
%s
</script>"""


@dataclass(frozen=True)
class Visit:
    """Result of visiting a page: `found` holds the probe's measurements, `console` the page's messages."""

    found: dict[str, Any]
    console: list[str]
    dom: str


def visit(
    tmp_path: Path,
    page: str,
    probe: str = "",
    *,
    before: str = "",
    phone: bool = False,
    when_loaded: bool = False,
) -> Visit:
    """Open a page in headless Chromium, run a probe in it, and read the resulting document.

    If `when_loaded`, the probe also waits for the page's images.
    """
    if before:
        page = page.replace("<body>", f"<body><script>{before}</script>", 1)
    probe = f"{probe}\nreport();"
    if when_loaded:
        probe = f'window.addEventListener("load", () => {{ {probe} }});'
    page = page.replace("</body>", PROBE % probe + "</body>")
    if phone:  # a Chromium window has a minimum width, a frame does not
        page = (
            f'<body><iframe srcdoc="{html.escape(page)}" width="390" height="844"></iframe></body>'
        )
    file = tmp_path / "report.html"
    file.write_text(page, encoding="utf-8")
    assert CHROMIUM is not None
    command = [
        *(CHROMIUM, "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run"),
        *(
            "--enable-unsafe-swiftshader",
            "--enable-logging=stderr",
            "--disable-background-networking",
        ),
        *(f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1440,900", "--dump-dom"),
        file.as_uri(),
    ]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, errors="replace")
    said = re.findall(r":CONSOLE[:(]\d+\)?\] (.*)", ran.stderr)
    console = [line for line in said if not any(part in line for part in HARMLESS)]
    (found,) = re.findall(r'<pre id="found">(.*?)</pre>', ran.stdout, re.DOTALL) or ["{}"]
    return Visit(json.loads(html.unescape(found)), console, ran.stdout)


def test_the_page_draws_and_says_nothing(tmp_path):
    """WebGL draws points, cameras and grid; rotating changes the picture; the console stays empty."""
    seen = visit(
        tmp_path,
        render(area()),
        """
        const view = document.getElementById("view");
        found.kind = document.documentElement.dataset.drawn;
        found.before = pixels(view);
        const first = view.toDataURL();
        const corner = view.getBoundingClientRect();
        const at = (type, x, y) => view.dispatchEvent(new PointerEvent(type, {pointerId: 1,
          clientX: corner.left + x, clientY: corner.top + y, bubbles: true, buttons: 1}));
        view.setPointerCapture = () => {};
        at("pointerdown", 500, 200); at("pointermove", 600, 260); at("pointerup", 600, 260);
        window.spnReport.view.draw();
        found.turned = view.toDataURL() !== first;
        found.layers = [...document.querySelectorAll("#legend label")].map(l => l.textContent);
        const points = document.querySelector("#legend input");
        points.click();
        window.spnReport.view.draw();
        found.without = pixels(view);
        found.strips = [...document.querySelectorAll(".lane canvas")].map(pixels);
        found.wide = document.documentElement.scrollWidth;
        """,
    )
    assert seen.console == []
    assert seen.found["kind"] == "webgl"
    assert seen.found["before"]["colors"] > 100
    assert seen.found["before"]["drawn"] > 0.02
    assert seen.found["turned"]
    assert seen.found["layers"] == [
        "points",
        "training (143)",
        "validation (7)",
        "truth: medium (38)",
        "GNSS fixes",
        "fly again (1)",
        "grid, 10 m",
        "north",
    ]
    assert seen.found["without"]["colors"] < seen.found["before"]["colors"] / 2
    assert all(strip["drawn"] > 0.02 for strip in seen.found["strips"])
    assert seen.found["wide"] <= 1440


def test_the_table_sorts_and_filters(tmp_path):
    """Clicking a column sorts, clicking again reverses; unknown values stay last; words filter the rows."""
    data = area()
    backwards = data.frames.select(np.arange(len(data.frames))[::-1])  # frames without a pose first
    seen = visit(
        tmp_path,
        render(replace(data, frames=backwards)),
        """
        found.heads = heads().map(h => h.textContent);
        const sigma = found.heads.indexOf("sigma, m");
        const click = k => heads()[k].querySelector("button").click();
        const body = document.querySelector("#table .rows");
        click(sigma);
        found.up = column(sigma);
        found.aria = heads()[sigma].getAttribute("aria-sort");
        click(sigma);
        found.down = column(sigma);
        const search = document.querySelector("#table input");
        search.value = "ambiguous";
        search.dispatchEvent(new Event("input"));
        found.failed = column(0);
        found.count = document.querySelector("#table .note").textContent;
        document.querySelector("#table tbody tr[data-row]").click();
        found.picked = document.getElementById("picked").textContent;
        """,
    )
    assert seen.console == []
    up, down = ([float(v) for v in seen.found[way]] for way in ("up", "down"))
    assert up == sorted(up)
    assert down == sorted(down, reverse=True)
    assert (up[0], down[0]) == (0.01, 0.05)
    assert seen.found["aria"] == "ascending"
    assert seen.found["failed"] == ["medium/000039.jpg", "medium/000038.jpg"]
    assert seen.found["count"] == "2 of 190 frames"
    assert "medium/000039.jpg" in seen.found["picked"]
    assert "ambiguous" in seen.found["picked"]


def test_a_frame_is_told_and_found_from_its_strip(tmp_path):
    """Hovering over a failed frame's tick shows the reason; a click selects it in table and strip."""
    seen = visit(
        tmp_path,
        render(area()),
        """
        const strip = document.querySelectorAll(".lane canvas")[1];
        const corner = strip.getBoundingClientRect();
        const at = type => strip.dispatchEvent(new PointerEvent(type,
          {clientX: corner.left + strip.clientWidth - 4, clientY: corner.top + 10, bubbles: true}));
        at("pointermove");
        found.tip = document.getElementById("tip").textContent;
        const before = strip.toDataURL();
        at("click");
        found.marked = strip.toDataURL() !== before;
        found.row = [...document.querySelectorAll("#table tr.picked")].map(r => r.cells[0].textContent);
        found.picked = document.getElementById("picked").textContent;
        """,
    )
    assert seen.console == []
    assert seen.found["tip"] == "medium/000039.jpg at 19.5 s: failed: ambiguous"
    assert seen.found["marked"]
    assert seen.found["row"] == ["medium/000039.jpg"]
    assert seen.found["picked"].startswith("medium/000039.jpg")


def test_a_page_without_a_model_is_quiet_too(tmp_path):
    """A page of frames without any pose lists them, draws them over time and raises no error."""
    data = area()
    frames = data.frames.select(~data.frames.evaluation)
    unknown = replace(
        frames.poses,
        centers=np.full((len(frames), 3), np.nan),
        quats_wxyz=np.full((len(frames), 4), np.nan),
    )
    frames = replace(frames, status=np.full(len(frames), "chosen"), poses=unknown)
    nothing = {"geo": None, "points": None, "coverage": None, "split": None, "audit": None}
    data = replace(data, frames=frames, units="model", model_record=None, **nothing)
    seen = visit(
        tmp_path,
        render(data),
        """
        found.rows = rows().length;
        found.strips = [...document.querySelectorAll(".lane canvas")].map(pixels);
        """,
    )
    assert seen.console == []
    assert seen.found["rows"] > 5
    assert all(strip["drawn"] > 0.02 for strip in seen.found["strips"])


def test_without_webgl_a_plain_canvas_draws(tmp_path):
    """Without WebGL, the view is drawn on a plain canvas and a note says so."""
    seen = visit(
        tmp_path,
        render(area()),
        """
        found.kind = document.documentElement.dataset.drawn;
        found.view = pixels(document.getElementById("view"));
        found.note = document.getElementById("fallback").textContent;
        """,
        before="""const usual = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
          return kind === "webgl" ? null : usual.call(this, kind, ...more); };""",
    )
    assert seen.console == []
    assert seen.found["kind"] == "2d"
    assert seen.found["view"]["colors"] > 100
    assert "no WebGL" in seen.found["note"]


def test_a_large_area_loads_in_three_seconds(tmp_path):
    """1,000 cameras with images and 100,000 points are below 8 MB, and appear within 3 s (best of two)."""
    data = area(cameras=1000, map_points=100_000)
    shown = pictures(data)
    most = MAX_BYTES // len(shown.thumbnails)  # a JPEG file may be longer than its content
    full = {name: image.ljust(most, b"\0") for name, image in shown.thumbnails.items()}
    page = render(data, pictures=replace(shown, thumbnails=full))
    visits = [
        visit(
            tmp_path,
            page,
            """
            found.milliseconds = Number(document.documentElement.dataset.milliseconds);
            found.view = pixels(document.getElementById("view"));
            """,
        )
        for _ in range(2)
    ]
    assert all(seen.console == [] and seen.found["view"]["drawn"] > 0.02 for seen in visits)
    assert min(seen.found["milliseconds"] for seen in visits) < 3000
    assert len(page) < 7_000_000  # 1 MB more for the figures of a run


def test_a_phone_shows_it_without_scrolling_sideways(tmp_path):
    """At a width of 390 pixels, only tables in their own frames are wider than the screen."""
    data = area()
    seen = visit(
        tmp_path,
        render(data, pictures=pictures(data)),
        """
        document.querySelector("#worst figure").click();
        const panel = document.getElementById("picked").getBoundingClientRect();
        found.panel = [panel.left, panel.right];
        found.window = window.innerWidth;
        found.wide = document.documentElement.scrollWidth;
        found.view = pixels(document.getElementById("view"));
        """,
        phone=True,
    )
    assert seen.console == []
    assert seen.found["window"] == 390
    assert seen.found["wide"] <= 390
    assert 0 <= seen.found["panel"][0] < seen.found["panel"][1] <= 390
    assert seen.found["view"]["drawn"] > 0.02


def test_estimates_are_drawn_joined_to_the_truth(tmp_path):
    """Estimates of the chosen run are red pyramids and lines; none are left with "no estimates"."""
    data = area()
    seen = visit(
        tmp_path,
        render(data, pictures=pictures(data)),
        """
        const select = document.getElementById("estimates");
        found.choices = [...select.options].map(option => option.textContent);
        found.layers = [...document.querySelectorAll("#legend label")]
          .filter(l => l.querySelector("input").checked).map(l => l.textContent);
        const red = () => countInView((r, g) => r === 0xd1 && g === 0x22);
        const choose = value => { select.value = value; select.dispatchEvent(new Event("change")); };
        const off = () => column(heads().findIndex(h => h.textContent.startsWith("estimate off, m")));
        const search = document.querySelector("#table input");
        search.value = "medium/00000";
        search.dispatchEvent(new Event("input"));
        found.coarse = [red(), document.getElementById("estimated").textContent, off()];
        choose("1");
        found.fixes = [red(), document.getElementById("estimated").textContent, off()];
        document.querySelector("#estimates").value = "-1";
        document.querySelector("#estimates").dispatchEvent(new Event("change"));
        found.none = [red(), document.getElementById("estimated").textContent];
        """,
    )
    assert seen.console == []
    assert seen.found["choices"] == [
        "first: network alone",
        "first: fixes, each image alone",
        "no estimates",
    ]
    assert "estimates (38)" in seen.found["layers"]
    assert not {"GNSS fixes", "fly again (1)"} & set(seen.found["layers"])
    assert seen.found["coarse"][0] > 300
    assert seen.found["coarse"][1].startswith(
        "first: network alone: 38 estimates of 38 frames are drawn."
    )
    assert seen.found["coarse"][2][:5] == ["5.00"] * 4 + ["10.00"]
    assert seen.found["fixes"][0] > 300
    assert (
        "37 estimates of 38 frames are drawn; frames without an estimate: 1."
        in seen.found["fixes"][1]
    )
    assert seen.found["fixes"][2][:2] == ["\N{EN DASH}", "0.00"]
    assert seen.found["none"] == [0, ""]


def test_the_ground_is_drawn_below_the_map(tmp_path):
    """An image of the ground, green and at the height of the cameras, is seen until its layer is off."""
    data = area()
    green = np.full((8, 8, 3), (0, 255, 0), np.uint8)
    webp = cv2.imencode(".webp", green, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    low, high = (data.frames.poses.centers[data.frames.registered][:, :2] + s for s in (-9, 9))
    ground = GroundTexture(tuple(low.min(axis=0)), tuple(high.max(axis=0)), 0.0, webp)
    seen = visit(
        tmp_path,
        render(data, pictures=replace(pictures(data), ground=ground)),
        """
        const green = () => countInView((r, g, b) => r < 9 && g > 246 && b < 9);
        found.on = green();
        const label = [...document.querySelectorAll("#legend label")].find(l => l.textContent === "ground");
        label.querySelector("input").click();
        found.off = green();
        """,
    )
    assert seen.console == []
    assert seen.found["on"] > 3000
    assert seen.found["off"] == 0


def test_a_click_anywhere_shows_the_image(tmp_path):
    """A camera, an estimate, a residual, a row and a picture show the frame; nothing is fetched for it."""
    data = area()
    seen = visit(
        tmp_path,
        render(data, pictures=pictures(data)),
        """
        const box = document.getElementById("picked"), one = query => document.querySelector(query);
        const told = () => ({hidden: box.hidden, text: box.textContent,
          image: box.querySelector("img") && box.querySelector("img").src.slice(0, 26),
          link: box.querySelector("a") && box.querySelector("a").getAttribute("href")});
        found.before = told();
        const view = document.getElementById("view"), corner = view.getBoundingClientRect();
        view.setPointerCapture = () => {};
        const press = ([x, y]) => { for (const type of ["pointerdown", "pointerup"]) view.dispatchEvent(
          new PointerEvent(type, {pointerId: 1, clientX: corner.left + x, clientY: corner.top + y})); };
        press(window.spnReport.view.placeOf("medium/000010.jpg").truth);
        found.camera = told();
        press(window.spnReport.view.placeOf("medium/000020.jpg").estimate);
        found.estimate = told();
        one('svg [data-frame="flight1/000050.jpg"]').dispatchEvent(new MouseEvent("click", {bubbles: true}));
        found.residual = told();
        one("#worst figure").click();
        found.worst = told();
        one('[title="Next frame"]').click();
        found.next = told();
        one("#table input").value = "flight1/000000";
        one("#table input").dispatchEvent(new Event("input"));
        one("#table tbody tr[data-row]").click();
        found.row = told();
        document.dispatchEvent(new KeyboardEvent("keydown", {key: "Escape", bubbles: true}));
        found.after = told();
        found.pictures = [...document.querySelectorAll("#worst img, #failed img")]
          .map(i => i.src.slice(0, 15));
        const fetched = performance.getEntriesByType("resource").map(entry => entry.name);
        found.fetched = fetched.filter(name => !name.startsWith("data:"));
        """,
        when_loaded=True,
    )
    assert seen.console == []
    assert seen.found["fetched"] == []
    assert seen.found["before"]["hidden"]
    shown = {"hidden": False, "image": "data:image/jpeg;base64,/9j"}
    for name, frame in (
        ("camera", "medium/000010.jpg"),
        ("estimate", "medium/000020.jpg"),
        ("residual", "flight1/000050.jpg"),
        ("worst", "medium/000004.jpg"),
        ("next", "medium/000005.jpg"),
    ):
        told = seen.found[name]
        assert told["text"].startswith(frame)
        assert {key: told[key] for key in shown} == shown
        assert told["link"] == f"./1-frames/{frame}"
    assert (
        "first: network alone: off by 10.00 m, 0.00\N{DEGREE SIGN}" in seen.found["worst"]["text"]
    )
    # The first frames have no image: the nearest one of the flight is shown under its own name.
    words = "No image of this frame is on this page: flight1/000003.jpg, 1.50 s later."
    assert words in seen.found["row"]["text"]
    assert seen.found["after"]["hidden"]
    assert set(seen.found["pictures"]) == {"data:image/jpeg"}
