"""The gateway's own keys, with which it signs what it promises about its logs."""

from __future__ import annotations

import base64
import binascii
import contextlib
import errno
import os
import stat
import tempfile
from collections.abc import Sequence
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac.answers import LogReceipt
from robosac.faults import unreadable
from robosac.signatures import key_id, show_public_key, sign_head
from service.keeping.record import SessionRecord
from service.keeping.store import Store


class GatewayKeys:
    """Ed25519 keys: the first signs, all are published, so that what an older one signed can still be checked.

    Parameters
    ----------
    file : Path, optional
        One key a line, base64 of its 32 bytes, the signing one first; made with one key if it is not there. By default
        the store keeps a key, made when a gateway first starts on it: all gateways on one store have the same.
    """

    def __init__(self, file: Path | None = None) -> None:
        self._file = file
        self._keys: Sequence[Ed25519PrivateKey] = ()
        self._id = ""

    async def start(self, store: Store) -> None:
        """Read the keys, or make one.

        Raises
        ------
        ValueError
            If the file, or the store, holds something else, or others may read the file.
        """
        text = await store.secret("gateway-signing", _new) if self._file is None else _read(self._file)
        where = "the database's gateway-signing" if self._file is None else f"ROBOSAC_GATEWAY_KEY_FILE: {self._file}"
        lines = enumerate(text.splitlines(), start=1)
        self._keys = [_key(line, f"{where}: line {number}") for number, line in lines if line.strip()]
        if not self._keys:
            raise ValueError(f"{where} holds no key")
        self._id = key_id(self._keys[0].public_key())

    def published(self) -> list[tuple[str, str, bool]]:
        """Id and public key (base64) of each, and whether it signs."""
        return [(key_id(key.public_key()), show_public_key(key), n == 0) for n, key in enumerate(self._keys)]

    def receipt(self, record: SessionRecord) -> LogReceipt:
        """The promise that a session's log begins as it is now."""
        signature = sign_head(self._keys[0], record.session_id, record.audit_seq, record.audit_head)
        return LogReceipt(
            session=record.session_id,
            seq=record.audit_seq,
            head=record.audit_head,
            key_id=self._id,
            signature=base64.b64encode(signature).decode(),
        )


def _new() -> str:
    return base64.b64encode(Ed25519PrivateKey.generate().private_bytes_raw()).decode()


def _read(file: Path) -> str:
    """The text of a file of keys, which is made if it is not there; nobody else may read it."""
    try:
        if not file.exists():
            _make(file)
        if file.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if _is_open_to_others(file.stat()):
            raise ValueError(f"ROBOSAC_GATEWAY_KEY_FILE: others may read {file}; take that right away (chmod 600)")
        return file.read_text()
    except (OSError, UnicodeError) as error:
        raise ValueError(f"ROBOSAC_GATEWAY_KEY_FILE: {file} cannot be read: {unreadable(error)}") from error


def _is_open_to_others(status: os.stat_result) -> bool:
    """Whether others may read a file, or write to it. One of root's, such as a secret of Kubernetes, is read by its
    group: else the gateway could not read it.
    """
    of_others = stat.S_IRWXG | stat.S_IRWXO if status.st_uid == os.geteuid() else stat.S_IWGRP | stat.S_IRWXO
    return bool(status.st_mode & of_others)


def _make(file: Path) -> None:
    """Make a file with a new key, at once and whole, unless somebody else has just done so."""
    descriptor, name = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)  # nobody else may read it
    try:
        with os.fdopen(descriptor, "w") as made:
            made.write(_new() + "\n")
            made.flush()
            os.fsync(made.fileno())
        with contextlib.suppress(FileExistsError):
            _link(name, file)
    finally:
        Path(name).unlink()


def _link(name: str, file: Path) -> None:
    """Let a file be found by another name, too, unless there is one of that name."""
    try:
        os.link(name, file)
    except FileExistsError:
        raise
    except OSError:  # a file system that knows no links
        descriptor = os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
        with os.fdopen(descriptor, "w") as made:
            made.write(Path(name).read_text())


def _key(line: str, where: str) -> Ed25519PrivateKey:
    try:
        return Ed25519PrivateKey.from_private_bytes(base64.b64decode(line.strip(), validate=True))
    except (binascii.Error, ValueError) as error:
        raise ValueError(f"{where} is no Ed25519 key, 32 bytes in base64") from error
