"""What a decision costs on disk: one transaction of SQLite in each mode of journal and flushing."""

import argparse
import sqlite3
import tempfile
import time
from pathlib import Path

import numpy as np

RECORD = b"x" * 5600  # an audit record of a frame with six vehicles
TURNS = 300
BASELINE = ("WAL", "FULL")
MODES = [BASELINE, ("WAL", "NORMAL"), ("DELETE", "FULL"), ("DELETE", "NORMAL")]


def opened(path: Path, journal: str, synchronous: str) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute(f"PRAGMA journal_mode = {journal}")
    connection.execute(f"PRAGMA synchronous = {synchronous}")
    connection.execute("CREATE TABLE state (session TEXT PRIMARY KEY, state BLOB)")
    connection.execute("CREATE TABLE audit (session TEXT, seq INTEGER, line BLOB, PRIMARY KEY (session, seq))")
    return connection


def decide(connection: sqlite3.Connection, seq: int) -> None:
    connection.execute("BEGIN IMMEDIATE")
    connection.execute("INSERT OR REPLACE INTO state VALUES ('s', ?)", (RECORD,))
    connection.execute("INSERT INTO audit VALUES ('s', ?, ?)", (seq, RECORD))
    connection.execute("COMMIT")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, help="on the disk to be measured; by default the one of temporary files")
    with tempfile.TemporaryDirectory(dir=parser.parse_args().folder) as folder:
        databases = {mode: opened(Path(folder) / "-".join(mode), *mode) for mode in MODES}
        times: dict[tuple[str, str], list[float]] = {mode: [] for mode in MODES}
        for seq in range(TURNS):
            for mode, connection in databases.items():
                started = time.perf_counter()
                decide(connection, seq)
                times[mode].append(time.perf_counter() - started)
        for mode, seconds in times.items():
            median, worst = np.percentile(seconds, [50, 99]) * 1e3
            ratio = np.median(seconds) / np.median(times[BASELINE])
            print(f"journal {mode[0]}, synchronous {mode[1]}: {median:.2f} ms, 99 % {worst:.2f} ms, ratio {ratio:.2f}")


if __name__ == "__main__":
    main()
