import os
import signal
import subprocess
import sys

import pytest

from robosac.files import is_special, replacing, write_text


def test_a_file_takes_its_place_at_the_end(tmp_path):
    path = tmp_path / "new" / "x.txt"
    with replacing(path) as beside:
        beside.write_text("all of it")
        assert not path.exists()
        assert beside.suffix == ".txt"
    assert path.read_text() == "all of it"
    assert list(path.parent.iterdir()) == [path]


def test_what_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.txt"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), replacing(path) as beside:
        beside.with_name("nothing").rename(beside)
    with pytest.raises(TypeError):
        write_text(path, 7)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_process_that_is_killed_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.txt"
    path.write_text("old")
    code = f"""
import os, signal
from pathlib import Path
from robosac.files import replacing
with replacing(Path({str(path)!r})) as beside:
    beside.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert path.read_text() == "old"


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "kept").mkdir()
    path, place = tmp_path / "link", tmp_path / "kept" / "x"
    path.symlink_to(place)
    write_text(path, "text")
    assert path.is_symlink()
    assert place.read_text() == "text"


def test_a_device_or_a_pipe_is_written_to(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_text(pipe, "text")
    assert os.read(reader, 10) == b"text"
    os.close(reader)
    assert is_special(pipe)
    assert not is_special(tmp_path)
    assert not is_special(tmp_path / "nothing")
