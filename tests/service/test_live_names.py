"""What the live page makes of vehicles that are called as what every object of JavaScript has."""

import json
import shutil
import subprocess

import pytest

from service.pages import STATIC

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="needs node")
NAMES = ["constructor", "toString", "rsu"]
SCRIPT = """
const made = () => new Proxy({ children: [], append(...more) { this.children.push(...more); },
  replaceChildren(...all) { this.children = all; }, setAttribute() {}, classList: { add() {} }, style: {} },
  { get: (element, name) => (name in element ? element[name] : undefined) });
globalThis.document = { createElement: made, createElementNS: made, getElementById: made, createTextNode: String };
const { showTeam } = await import(process.argv[1]);
const body = made();
showTeam(body, JSON.parse(process.argv[2]));
console.log(JSON.stringify(body.children.map((row) => row.children.slice(1, 3).map((cell) => cell.textContent))));
"""


def test_a_team_is_shown_whatever_its_vehicles_are_called():
    rejected = [{"vehicle_id": name, "why": "no message came"} for name in NAMES[:2]]
    frame = {
        "accepted": NAMES[2:],
        "rejected": rejected,
        "named": [],
        "teammates": [{"vehicle_id": "rsu", "range_m": 12.0}],
        "suspicion": {"rsu": 0.25},
    }
    panels = (STATIC / "panels.js").as_uri()
    command = [NODE, "--input-type=module", "--eval", SCRIPT, panels, json.dumps(frame)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [["not known"] * 2, ["12.0 m", "0.250"], ["not known"] * 2]


ASKING = """
globalThis.fetch = () => { throw new TypeError('it was asked'); };
const { ask, Refused } = await import(process.argv[1]);
const told = [];
for (const token of ['\\u201c0123456789abcdef\\u201d', 'a\\nb', 'a-good-token-0123'])
  await ask('v1/live', token).catch((error) => told.push(error instanceof Refused ? error.status : error.message));
console.log(JSON.stringify(told));
"""


def test_a_token_that_no_header_takes_is_known_to_nobody():
    command = [NODE, "--input-type=module", "--eval", ASKING, (STATIC / "stream.js").as_uri()]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [401, 401, "it was asked"]
