import math
import sqlite3
import threading
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from clients.errors import GatewayUnreachable
from clients.metering import CountingTransport, Meter, Reading


def test_what_a_frame_took_is_the_difference_over_the_frames():
    before = Reading(1.0, 0.5, 10.0, 4096.0, 100, 50)
    after = Reading(1.6, 0.6, 10.8, math.nan, 900, 450)
    assert after.since(before, 4) == {
        "gateway_cpu_ms": pytest.approx(150.0),
        "client_cpu_ms": pytest.approx(25.0),
        "machine_cpu_ms": pytest.approx(200.0),
        "disk_bytes": None,
        "sent_bytes": 200.0,
        "received_bytes": 100.0,
    }
    assert set(after.since(before, 0).values()) == {None}


async def test_the_size_of_a_database_counts_what_is_in_its_log_only(tmp_path):
    path = tmp_path / "some.db"
    meter = Meter([], f"sqlite:///{path}", CountingTransport())
    assert math.isnan((await meter.read()).disk_bytes)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("CREATE TABLE some (body BLOB)")
        connection.commit()
        empty = (await meter.read()).disk_bytes
        connection.execute("INSERT INTO some VALUES (?)", (b"x" * 100_000,))
        connection.commit()
        assert 90_000 < (await meter.read()).disk_bytes - empty < 110_000
        assert path.stat().st_size < 100_000


async def test_a_gateway_that_is_not_there_is_named():
    meter = Meter(["http://127.0.0.1:1"], "sqlite://", CountingTransport())
    with pytest.raises(GatewayUnreachable, match=r"http://127\.0\.0\.1:1/metrics"):
        await meter.read()


async def test_frames_are_counted_for_each_gateway():
    text = (
        "# TYPE robosac_frames_total counter\n"
        'robosac_frames_total{source="consensus"} 7.0\nrobosac_frames_total{source="ego_only"} 2.0\n'
        'robosac_frames_created{source="consensus"} 1.7e9\n'
    )
    with answering(text) as first, answering("# TYPE robosac_frames_total counter\n") as second:
        assert await Meter([first, second], "sqlite://", CountingTransport()).frames() == [9, 0]
        reading = await Meter([first], "sqlite://", CountingTransport()).read()
        assert math.isnan(reading.gateway_cpu_s)


@contextmanager
def answering(text):
    """A server that answers every request with a text; its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
