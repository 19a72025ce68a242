"""The live page in a real browser, fed by a real gateway with an attacker in the team."""

import asyncio
import base64
import io
import json
import re
import shutil
import time
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from clients.client import GatewayClient
from clients.local_gateway import GatewayProcess
from clients.simulation import Fleet
from robosac.attacks import PGD
from robosac.boxes import corners
from robosac.scenes import IntersectionScene
from tests.service.credentials import KEY

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs chromium and chromedriver")
TOKEN = "a-viewers-token-0123"
FRAMES = 3
QUIET = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--force-device-scale-factor=1"),
]
COLOURS = {"confirmed": "#0072b2", "single_witness": "#e69f00", "disputed": "#cc79a7", "repaired": "#56b4e9"}


class Page:
    """The browser's one tab."""

    def __init__(self, driver, url):
        self.driver, self.url = driver, url

    def run(self, script, *values):
        return self.driver.execute_script(script, *values)

    def text(self, selector):
        return self.run("return document.querySelector(arguments[0]).innerText", selector)

    def rows(self, selector):
        cells = "[...document.querySelectorAll(arguments[0])].map(row => [...row.cells].map(cell => cell.innerText))"
        return self.run(f"return {cells}", selector)

    def until(self, script, timeout_s=30.0):
        """Wait for a truth."""
        end = time.monotonic() + timeout_s
        while not (value := self.run(f"return {script}")):
            assert time.monotonic() < end, f"{script}; the page says {self.text('body')[:2000]}"
            time.sleep(0.05)
        return value

    def until_frame(self, number):
        self.until(f"document.querySelector('#scene').dataset.frame == '{number}'")

    def press(self, key):
        self.run("document.activeElement.blur()")
        self.driver.find_element("tag name", "body").send_keys(key)

    def show_only(self, *layers):
        self.run(
            "for (const box of document.querySelectorAll('#legend input'))"
            "if (box.checked != arguments[0].includes(box.name)) box.click()",
            list(layers),
        )

    def picture(self):
        """The view's pixels (h, w, 3)."""
        encoded = self.run("return document.querySelector('#scene').toDataURL()").partition(",")[2]
        with Image.open(io.BytesIO(base64.b64decode(encoded))) as image:
            background = Image.new("RGBA", image.size, "white")
            background.alpha_composite(image.convert("RGBA"))
            return np.asarray(background.convert("RGB")).astype(int)

    def faults(self):
        """What a checker of accessibility finds that is serious."""
        from axe_core_python.base import AXE_SCRIPT

        self.run(AXE_SCRIPT)
        found = self.driver.execute_async_script("axe.run().then(arguments[arguments.length - 1])")
        assert len(found["passes"]) > 15
        serious = [one for one in found["violations"] if one["impact"] in ("serious", "critical")]
        return [(one["id"], [node["html"][:200] for node in one["nodes"]]) for one in serious]

    def complaints(self):
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def requested(self):
        """Addresses that the browser asked for since the last call, but for what the page's policy kept it from."""
        events = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        asked = [one["params"] for one in events if one["method"] == "Network.requestWillBeSent"]
        failed = [one["params"] for one in events if one["method"] == "Network.loadingFailed"]
        kept = {one["requestId"] for one in failed if one.get("blockedReason") == "csp"}
        return [one["request"]["url"] for one in asked if one["requestId"] not in kept]


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (*QUIET, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def fleet(detector):
    """A team with an attacker: what it sends in each frame, who attacks, and whom."""
    fleet = Fleet(IntersectionScene(3), detector, 1, 1, PGD(steps=5), 0)
    frames = [fleet.sense(index)[0] for index in range(FRAMES + 1)]
    (attacker,) = fleet.attackers
    return SimpleNamespace(frames=frames, attacker=attacker, ego=fleet.egos[0], team=fleet.teammates(fleet.egos[0]))


@pytest.fixture(scope="module")
def gateway(tmp_path_factory):
    """A gateway that can be stopped and started again at the same address."""
    folder = tmp_path_factory.mktemp("gateway")
    place = SimpleNamespace(database=f"sqlite:///{folder}/live.db", log=folder / "gateway.log")

    def start(port=None, **more):
        place.process = GatewayProcess(place.log, place.database, port=port, **more)
        asyncio.run(place.process.ready())
        return place.process

    place.start = start
    start()
    yield place
    asyncio.run(place.process.stop())


def play(url, fleet, numbers, session=None):
    """Post frames, in a session that is opened if there is none yet; the session and the answers."""

    async def posting():
        async with GatewayClient(url) as client:
            ours = session or await client.open_session(fleet.ego, fleet.team, latency_budget_ms=20_000, gather_ms=0)
            ego = client.vehicle(ours.session_id, fleet.ego, ours.ego_token)
            return ours, [await ego.post_frame(n, fleet.frames[n].message, fleet.frames[n].sent) for n in numbers]

    return asyncio.run(posting())


def resize(page, width, height):
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def test_the_api_is_described_without_the_internet(browser, gateway):
    page = Page(browser, gateway.process.url)
    page.requested(), page.complaints()
    for path in ("/docs", "/redoc"):
        page.driver.get(f"{page.url}{path}")
        page.until("document.body.innerText.includes('/v1/sessions')")
    assert [address for address in page.requested() if not address.startswith((f"{page.url}/", "data:", "blob:"))] == []
    logo = "https://cdn.redoc.ly/redoc/logo-mini.svg' violates the following Content Security Policy"  # kept from it
    assert all(logo in complaint for complaint in page.complaints())


def test_a_link_that_names_no_session_leads_to_the_page_all_the_same(browser, gateway):
    page = Page(browser, gateway.process.url)
    for link, said in (("%", "Connected"), ("0123456789abcdef", "No frame of this session was answered lately")):
        page.driver.get("about:blank")
        page.driver.get(f"{page.url}/#{link}")
        page.until(f"document.querySelector('#state').innerText.startsWith({said!r})")


def test_a_fleet_with_an_attacker_is_watched(browser, gateway, fleet):
    url = gateway.process.url
    page = Page(browser, url)
    page.driver.get(f"{url}/")
    page.until("document.querySelector('#state').innerText.startsWith('Connected')")
    assert "No frame was answered yet" in page.text("main")
    session, answers = play(url, fleet, range(FRAMES))
    page.until_frame(FRAMES - 1)

    assert answers[-1].named == (fleet.attacker,)
    check_the_attacker(page, fleet.attacker)
    check_the_boxes(page, answers[-1])
    check_keys_and_scrubbing(page)
    check_widths_and_accessibility(page)
    assert page.complaints() == []

    page.driver.refresh()
    page.until_frame(FRAMES - 1)
    page.until(f"document.querySelector('#scrub').max == '{FRAMES - 1}'")
    check_the_attacker(page, fleet.attacker)
    assert page.complaints() == []

    began = time.monotonic()
    assert asyncio.run(gateway.process.stop())
    assert time.monotonic() - began < 4, "the stream of a viewer kept the gateway from ending"
    page.until("document.querySelector('#state').innerText.includes('Connection lost')")
    assert all("net::ERR_" in complaint for complaint in page.complaints())

    more = {"api_key": KEY, "settings": {"ROBOSAC_VIEWER_TOKENS": TOKEN}}
    gateway.start(gateway.process.port, **more)
    page.until("!document.querySelector('#token-form').hidden")
    for text, outcome in (("wrong" * 4, "does not know this token"), (TOKEN, "Connected")):
        field = page.driver.find_element("id", "token")
        field.send_keys(text + "\n")
        page.until(f"document.querySelector('#state').innerText.includes({outcome!r})")
    play(url, fleet, [FRAMES], session)
    page.until_frame(FRAMES)
    assert page.run("return document.querySelector('#scrub').max") == str(FRAMES)  # none is lost, none twice
    check_the_attacker(page, fleet.attacker)
    assert all(re.search("net::ERR_|status of 401", complaint) for complaint in page.complaints())

    requested = page.requested()
    assert len(requested) > 15
    assert [address for address in requested if not address.startswith((f"{url}/", "data:"))] == []


def check_the_attacker(page, attacker):
    """It turns up as named, with its evidence in words."""
    named = page.text("#named")
    assert attacker in named
    assert re.search(r"Frame \d+ of those judged: .*makes an attack .* times more likely", named)
    (row,) = [row for row in page.rows("#team tr") if row[0].strip() == attacker]
    assert float(row[2]) > 0.9
    assert row[3].startswith("left out: named as an attacker")
    assert f"{attacker} (named as an attacker)" in page.text("#log")
    assert "in dissensus" in page.text("#tests") or "in consensus" in page.text("#tests")
    page.until(f"document.querySelector('#sessions').innerText.includes('named: {attacker}')")


def check_the_boxes(page, answer):
    """Table and canvas show the answer's boxes, and no other as answered."""
    page.run("document.querySelector('#table-details').open = true")
    page.until("document.querySelectorAll('#table tr').length")
    rows = [row for row in page.rows("#table tr") if row[0].startswith("answered: ")]
    shown = np.array([[float(cell) for cell in row[1:7]] for row in rows])
    expected = answer.boxes.copy()
    expected[:, 4] = np.degrees(expected[:, 4])
    assert len(expected) > 10
    np.testing.assert_allclose(shown, expected, atol=0.051)
    told = [standing.status.value for standing in answer.support]
    assert [row[0].removeprefix("answered: ").replace(" ", "_") for row in rows] == told
    for row, standing in zip(rows, answer.support, strict=True):
        assert row[7] == ", ".join(standing.witnesses)

    for status, colour in COLOURS.items():
        page.show_only(status)
        boxes = answer.boxes[[one == status for one in told]]
        wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
        painted = np.argwhere(np.abs(page.picture() - wanted).max(axis=2) < 40)[:, ::-1]
        inside, distance = outlines(page, boxes, painted)
        assert inside.all(), f"boxes that are {status} are missing"
        assert (distance < 12).all(), f"there are more than the boxes that are {status}"
    page.show_only(*page.run("return [...document.querySelectorAll('#legend input')].map(box => box.name)"))


def outlines(page, boxes, painted):
    """Whether of each box enough of the outline is painted, where it is in the view; and of each painted pixel how far
    from an outline it is.
    """
    scale = float(page.run("return document.querySelector('#scene').dataset.scale"))
    width, height = page.run("const c = document.querySelector('#scene'); return [c.clientWidth, c.clientHeight]")
    drawn, distance = [], np.full(len(painted), np.inf)
    for outline in corners(boxes):
        points = np.array([width / 2, height / 2]) + outline * (scale, -scale)
        edges = zip(points, np.roll(points, -1, axis=0), strict=True)
        along = np.vstack([a + (b - a) * np.linspace(0, 1, 60)[:, None] for a, b in edges])
        along = along[((along > 2) & (along < (width - 2, height - 2))).all(axis=1)]
        gaps = (
            np.hypot(*(along[:, None] - painted[None]).transpose(2, 0, 1))
            if len(along)
            else np.zeros((0, len(painted)))
        )
        drawn.append(len(along) == 0 or (gaps.min(axis=1, initial=np.inf) < 2.5).mean() > 0.4)
        distance = np.minimum(distance, gaps.min(axis=0, initial=np.inf))
    return np.array(drawn, dtype=bool), distance


def check_keys_and_scrubbing(page):
    from selenium.webdriver.common.keys import Keys

    page.press(" ")
    page.until("document.querySelector('#pause').innerText == 'Go on'")
    page.press(Keys.ARROW_LEFT)
    page.until_frame(FRAMES - 2)
    page.press(Keys.HOME)
    page.until_frame(0)
    page.press(Keys.ARROW_RIGHT)
    page.until_frame(1)
    page.run("const s = document.querySelector('#scrub'); s.value = 0; s.dispatchEvent(new Event('input'))")
    page.until_frame(0)
    page.press(Keys.END)
    page.until_frame(FRAMES - 1)
    assert page.text("#pause") == "Pause"


def check_widths_and_accessibility(page):
    for width, scheme in ((1280, "light"), (360, "dark")):
        resize(page, width, 900)
        media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        page.until(f"innerWidth == {width}")
        assert page.run("return document.documentElement.scrollWidth") <= width
        assert page.faults() == []
    resize(page, 1280, 1000)
