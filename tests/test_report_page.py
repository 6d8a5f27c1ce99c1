"""The page of `headway report` in a browser: headless Chromium, spoken to through a pipe (DevTools
protocol). Where there is no `chromium` this is skipped, but on the build server it fails."""

import http.server
import itertools
import json
import os
import re
import select
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from headway.cli.main import main
from headway.cli.page import animation, scene
from headway.cli.page.scene import NoPicture
from headway.cli.simulation import Simulation
from headway.configs.load import load_config
from headway.controller.record.reader import read_run

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
PATIENCE_S = 300.0  # a loaded computer paints a few pictures a second
READY = "document.documentElement.dataset.ready"
OPTIONS = (
    "--headless",
    "--no-sandbox",  # which needs rights that a container has not; the page is our own
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--autoplay-policy=no-user-gesture-required",
    "--proxy-server=127.0.0.1:9",  # nobody answers there
    "--remote-debugging-pipe",
)


class Browser:
    """A browser with one page. Keeps the events that the page causes."""

    def __init__(self, program: str, folder: Path) -> None:
        read, self._to = os.pipe()
        self._from, write = os.pipe()
        # The browser reads from descriptor 3 and writes to 4; bash puts them there.
        command = f'exec "$@" 3<&{read} 4>&{write}'
        self._process = subprocess.Popen(
            ["bash", "-c", command, "", program, *OPTIONS, f"--user-data-dir={folder}"],
            pass_fds=(read, write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read)
        os.close(write)
        self._numbers, self._buffer = itertools.count(1), b""
        self._session: dict[str, str] = {}
        self.events: list[dict[str, Any]] = []
        page = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        self._session = {"sessionId": session}
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """Calls a method of the protocol; returns its result."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters, **self._session}
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer)
                return answer["result"]
            self.events.append(answer)

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert select.select([self._from], [], [], PATIENCE_S)[0], "the browser is stuck"
            chunk = os.read(self._from, 1 << 16)
            assert chunk, f"the browser has ended: {self._process.wait(PATIENCE_S)}"
            self._buffer += chunk
        message, _, self._buffer = self._buffer.partition(b"\0")
        answer: dict[str, Any] = json.loads(message)
        return answer

    def js(self, expression: str) -> Any:
        """The value of an expression in the page; of a promise what it promises."""
        result = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, condition: str) -> None:
        """Waits until an expression in the page is true."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.js(condition):
            assert time.monotonic() < deadline_s, f"never: {condition}"
            self.js("new Promise(requestAnimationFrame)")

    def open(self, page: Path) -> None:
        """Opens a report and waits until all is drawn."""
        self.events.clear()
        self.call("Page.navigate", url=page.as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._read())
        self.js("new Promise((done) => setTimeout(done, 0))")

    def show(self, width: int, height: int = 900, **media: str) -> None:
        """The window's size and the reader's preferences."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        features = [{"name": k.replace("_", "-"), "value": v} for k, v in media.items()]
        self.call("Emulation.setEmulatedMedia", features=features)

    def mouse(self, *steps: tuple[str, float, float]) -> None:
        """Events of the left button: (mousePressed | mouseMoved | mouseReleased, x, y)."""
        for kind, x, y in steps:
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                buttons=int(kind != "mouseReleased"),
                clickCount=1,
            )

    def close(self) -> None:
        self._session = {}
        self.call("Browser.close")
        self._process.wait(PATIENCE_S)
        os.close(self._to)
        os.close(self._from)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    program = shutil.which("chromium")
    if not program:
        message = "no chromium: sudo apt-get install -y chromium"
        assert not os.environ.get("HEADWAY_CI"), message
        pytest.skip(message)
    browser = Browser(program, tmp_path_factory.mktemp("browser"))
    yield browser
    browser.close()


def simulated(folder: Path, *changes: str) -> Path:
    simulation = Simulation(load_config(CONFIGS / "arm2.yaml", list(changes)), CONFIGS)
    simulation.run()
    folder.mkdir()
    simulation.keep(folder)
    return folder


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A page of one run, and one of two."""
    try:
        scene._context().free()
    except NoPicture as error:
        assert not os.environ.get("HEADWAY_CI"), error
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("runs")
    loss = "sim.to_device.loss=0.1", "sim.to_host.loss=0.1"
    first = simulated(folder / "first", "duration_s=1.5", *loss)
    second = simulated(folder / "second", "duration_s=1", "mpc.enabled=false")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(animation, "FPS", 10.0)
        assert main(["report", str(first)]) == 0
        assert main(["report", str(first), str(second)]) == 0
    return {"one": first / "report.html", "two": first / "report-vs-second.html"}


@pytest.fixture
def page(browser: Browser, pages: dict[str, Path]) -> Browser:
    """The page of one run, at rest."""
    browser.show(1280, prefers_reduced_motion="reduce")
    browser.open(pages["one"])
    return browser


def complaints(browser: Browser) -> list[dict[str, Any]]:
    """Exceptions and all that was written to the console, such as what the policy forbade."""
    kinds = {"Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"}
    return [event["params"] for event in browser.events if event["method"] in kinds]


def requests(browser: Browser) -> list[str]:
    found = [e["params"] for e in browser.events if e["method"] == "Network.requestWillBeSent"]
    return [params["request"]["url"] for params in found]


FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
SHOWN = "document.getElementById('film').dataset.shown"
# Left edge, middle height and width of the first plot's area.
SPOT = """(() => {
  const over = document.querySelector('.u-over');
  over.scrollIntoView({ block: 'center' });
  const { left, top, width, height } = over.getBoundingClientRect();
  return [left, top + height / 2, width];
})()"""
# Of each plot, how many of its pixels are not as the first one.
INK = """[...document.querySelectorAll('.uplot canvas')].map((canvas) => {
  const image = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  const pixels = new Uint32Array(image.data.buffer);
  return pixels.filter((pixel) => pixel !== pixels[0]).length;
})"""
# Of each plot, a text that tells its pictures apart.
PIXELS = """Promise.all([...document.querySelectorAll('.uplot canvas')].map(async (canvas) => {
  const text = new TextEncoder().encode(canvas.toDataURL());
  const digest = await crypto.subtle.digest('SHA-256', text);
  return Array.from(new Uint8Array(digest), (byte) => byte.toString(16)).join('');
}))"""
# The same of the animation.
FILM = """(() => {
  const canvas = document.getElementById('film');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  return data.reduce((sum, value, i) => (sum * 31 + value * (i % 7)) % 1000003, 0);
})()"""


@pytest.mark.parametrize("which", ["one", "two"])
@pytest.mark.parametrize("width", [1280, 400])
def test_all_is_drawn_and_nothing_fetched(
    browser: Browser, pages: dict[str, Path], which: str, width: int
) -> None:
    path = pages[which]
    browser.show(width)
    browser.open(path)
    browser.until(SHOWN)
    plots = len(re.findall(r'data-plot="', path.read_text()))
    assert int(browser.js(READY)) == plots >= 14
    ink = browser.js(INK)
    assert len(ink) == plots and min(ink) > 1500
    assert complaints(browser) == []
    assert requests(browser) == [path.as_uri()]
    assert browser.js("document.documentElement.scrollWidth") <= width
    assert browser.js("document.querySelectorAll('.uplot .u-axis').length") == 2 * plots


def test_the_policy_lets_nothing_out(page: Browser) -> None:
    """Whatever a script tries: a server beside the page hears nothing of it."""
    heard: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            heard.append(self.path)
            self.send_error(404)

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"http://127.0.0.1:{server.server_port}/"
        refused = page.js(
            f"""(async () => {{
              const events = [];
              addEventListener('securitypolicyviolation', (e) => events.push(e.effectiveDirective));
              await fetch('{url}').catch(() => null);
              const image = new Image();
              await new Promise((done) => {{ image.onerror = done; image.src = '{url}x.png'; }});
              const script = document.createElement('script');
              script.textContent = 'window.foreign = true';
              document.body.append(script);
              await new Promise((done) => setTimeout(done, 0));
              return [...new Set(events), window.foreign];
            }})()"""
        )
        server.shutdown()
        thread.join()
    assert refused == ["connect-src", "img-src", "script-src-elem", None]
    assert heard == []


def test_the_film_stands_still_for_those_who_want_that(page: Browser) -> None:
    page.until(f"{SHOWN} === '0'")
    assert page.js("document.getElementById('play').textContent") == "Play"


def test_the_film_plays(browser: Browser, pages: dict[str, Path]) -> None:
    browser.show(1280)
    browser.open(pages["one"])
    browser.until(f"{SHOWN} > 1")
    first = browser.js(FILM)
    mark = "document.querySelector('.mark').style.transform"
    before = browser.js(mark)
    browser.until(f"{SHOWN} > 6")
    assert browser.js(FILM) != first
    assert browser.js(mark) != before
    browser.js("document.getElementById('play').click()")  # it stops
    stopped = browser.js("document.getElementById('clock').value")
    browser.js("new Promise((done) => setTimeout(done, 120))")
    assert browser.js("document.getElementById('clock').value") == stopped


def test_the_film_begins_again(browser: Browser, pages: dict[str, Path]) -> None:
    browser.show(1280)
    browser.open(pages["one"])
    last = browser.js("JSON.parse(data.textContent).film.pictures.length") - 1
    browser.until(f"{SHOWN} === '{last}'")
    browser.until(f"{SHOWN} < 3")


def test_the_slider_and_a_click_in_a_plot_lead_to_a_time(page: Browser) -> None:
    slider = "const time = document.getElementById('time');"
    page.js(f"{slider} time.value = 1; time.dispatchEvent(new Event('input'));")
    page.until(f"{SHOWN} === '10'")
    assert page.js("document.getElementById('clock').value") == "1.00 s"
    at_one = page.js(FILM)
    x, y, width = page.js(SPOT)
    end_s = json.loads(page.js("JSON.stringify(JSON.parse(data.textContent).whole[1])"))
    spot = x + width * 0.5 / end_s
    page.mouse(("mousePressed", spot, y), ("mouseReleased", spot, y))
    page.until(f"{SHOWN} === '5'")
    assert page.js(FILM) != at_one
    assert float(page.js("document.getElementById('clock').value").split()[0]) == pytest.approx(
        0.5, abs=0.02
    )
    marks = page.js(
        """[...document.querySelectorAll('.mark')].map((mark) =>
          (mark.getBoundingClientRect().left - mark.parentElement.getBoundingClientRect().left)
          / mark.parentElement.clientWidth)"""
    )
    assert len(marks) >= 12
    assert marks == pytest.approx([0.5 / end_s] * len(marks), abs=0.01)


def test_a_drag_zooms_all_plots(page: Browser) -> None:
    whole = "document.getElementById('whole')"
    assert page.js(f"{whole}.hidden")
    before = page.js(PIXELS)
    x, y, width = page.js(SPOT)
    page.mouse(
        ("mousePressed", x + 0.3 * width, y),
        ("mouseMoved", x + 0.4 * width, y),
        ("mouseMoved", x + 0.6 * width, y),
        ("mouseReleased", x + 0.6 * width, y),
    )
    page.until(f"!{whole}.hidden")
    page.js(FRAMES)
    changed = [a != b for a, b in zip(before, page.js(PIXELS), strict=True)]
    assert changed.count(False) == 1  # the histogram, which has no time
    page.js(f"{whole}.click()")
    page.until(f"{whole}.hidden")
    page.js(FRAMES)
    assert page.js(PIXELS) == before
    assert complaints(page) == []


def test_in_the_dark(browser: Browser, pages: dict[str, Path]) -> None:
    bright = "getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).map(Number)"
    found = {}
    for theme in ("light", "dark"):
        browser.show(1280, prefers_color_scheme=theme, prefers_reduced_motion="reduce")
        browser.open(pages["one"])
        found[theme] = browser.js(PIXELS)
        assert (min(browser.js(bright)) > 200) == (theme == "light")
    assert not set(found["light"]) & set(found["dark"])
    browser.show(1280, prefers_color_scheme="light", prefers_reduced_motion="reduce")
    browser.js(FRAMES)
    assert browser.js(PIXELS) == found["light"]


def test_the_cursor_reads_what_the_record_has(page: Browser, pages: dict[str, Path]) -> None:
    x, y, width = page.js(SPOT)
    page.mouse(("mouseMoved", x + 0.4 * width, y))
    page.js(FRAMES)
    time_s, band, error_mrad = page.js(
        "[...document.querySelectorAll('.uplot')[0].querySelectorAll('.u-series:not(.edge)')]"
        ".map((row) => row.querySelector('.u-value').textContent)"
    )
    run = read_run(pages["one"].parent).arrays
    row = int(np.argmin(np.abs(run["truth_s"] - float(time_s))))
    near = slice(row - 1, row + 2)  # the cursor's time is rounded
    error = 1e3 * (run["truth_position"] - run["truth_reference"])[near, 0]
    assert np.abs(error - float(error_mrad)).min() < 1e-3 * np.abs(error).max()
    low, high = map(float, band.split(" to "))
    tick = int(np.argmin(np.abs(run["now_s"] - float(time_s))))
    sigmas = 2e3 * np.sqrt(run["now_covariance"][tick - 1 : tick + 2, 0])
    assert np.abs((high - low) / 2 - sigmas).min() < 1e-3


def test_the_table_has_the_summary(page: Browser, pages: dict[str, Path]) -> None:
    summary = json.loads(pages["one"].with_name("summary.json").read_text())
    name, *cells = page.js("document.querySelector('.data tbody tr').innerText").split("\t")
    assert name == "tracking error, rms [mrad]"
    assert [float(cell) for cell in cells] == pytest.approx(summary["tracking"]["rms"], rel=1e-3)
