"""Two gateway processes behind the real HAProxy, with the configuration that ships and TLS."""

import asyncio
import datetime
import ipaddress
import re
import subprocess
from pathlib import Path

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from clients.client import GatewayClient
from clients.continuity import Traffic, affinity, prepare
from clients.errors import GatewayUnreachable
from clients.load_test import DEFENSE
from clients.proxied import configured, program, proxied
from tests.service.conftest import answered_since, until

CONFIG = Path(__file__).parents[2] / "deploy" / "haproxy.cfg"
KEY = "a-key-of-the-proxied-gateway"
pytestmark = pytest.mark.skipif(program() is None, reason="HAProxy is not installed")


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """A certificate of loopback, signed by itself, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    path = tmp_path_factory.mktemp("tls") / "gateway.pem"
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    path.write_bytes(private + made.public_bytes(Encoding.PEM))
    return path


def test_what_ships_is_a_configuration(tmp_path, certificate):
    text = CONFIG.read_text().replace("/etc/robosac/gateway.pem", str(certificate))
    (tmp_path / "haproxy.cfg").write_text(text)
    checked = subprocess.run(
        [program(), "-c", "-f", tmp_path / "haproxy.cfg"], check=False, capture_output=True, text=True
    )
    assert (checked.returncode, checked.stderr) == (0, "")
    assert re.search(r"^global\n    user haproxy\b.*\n    group haproxy\n", text, re.MULTILINE)  # else it stays root


def test_who_is_not_root_keeps_its_own_user(monkeypatch):
    for user, kept in ((0, True), (1000, False)):
        monkeypatch.setattr("os.geteuid", lambda user=user: user)
        assert ("user haproxy" in configured(CONFIG.read_text(), [1, 2], 3, None)) == kept


def test_only_the_shipped_configuration_is_changed():
    with pytest.raises(ValueError, match="ships"):
        configured("frontend gateway\n    bind :80\n", [1, 2], 3, None)


async def proxy_said(folder, text):
    await until(lambda: text in (folder / "haproxy.log").read_text(), within_s=60.0)


async def test_sessions_go_on_while_one_process_is_restarted_and_the_other_killed(tmp_path, certificate, monkeypatch):
    async with proxied(CONFIG, tmp_path, f"sqlite:///{tmp_path}/robosac.db", KEY, 2, certificate) as gateways:
        with pytest.raises(httpx.ConnectError, match="certificate"):  # nobody vouches for it but the test
            await asyncio.to_thread(httpx.get, f"{gateways.url}/readyz", trust_env=False)
        async with GatewayClient(gateways.url) as client:
            with pytest.raises(GatewayUnreachable, match="SSL_CERT_FILE"):
                await client.detectors()
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        async with GatewayClient(gateways.url) as client:
            assert await client.detectors()
        async with gateways.client() as client:
            for path in ("/metrics", "/%6detrics", "/metric%73?a=b"):  # which are all one to a gateway
                refused = await client._http.get(path)
                assert refused.status_code == 404, path
            session = await client.open_session("ego", ["rsu"])
            token, statuses = session.ego_token, []
            for number in range(18):  # one process counts them, however their path is written
                path = f"/v1/{('sessions', '%73essions')[number % 2]}/{session.session_id}/token"
                answer = await client._http.post(path, headers={"Authorization": f"Bearer {token}"})
                statuses.append(answer.status_code)
                token = answer.json().get("token", token)
            assert statuses == [201] * 16 + [429] * 2
            traffic = Traffic(gateways.client, prepare(2), rate_hz=3.0, budget_ms=20_000.0)
            await traffic.open(4, DEFENSE)
            traffic.begin("both")
            await answered_since(traffic, 2)
            traffic.begin("restart")
            await gateways.end(0, gently=True)
            await answered_since(traffic, 2)
            await proxy_said(tmp_path, "Server sessions/p1 is DOWN")
            await gateways.begin(0)
            await proxy_said(tmp_path, "Server sessions/p1 is UP")
            await answered_since(traffic, 1)
            traffic.begin("kill")
            await gateways.end(1, gently=False)
            await answered_since(traffic, 2)
            await traffic.stop()
            wrong, writers = await traffic.check()
    assert wrong == []
    assert affinity(writers, moves=3) == []
    assert all(len(names) >= 2 for names in writers)  # wherever it was, it had to move
    for phase in traffic.phases:
        told = phase.as_dict()
        assert phase.answered >= 4, told
        assert 0 < phase.longest_wait_s < phase.longest_gap_s + 0.1, told  # it waits since its last answer at most
        assert (phase.whole, phase.tested) == (phase.answered, phase.answered), told
        assert phase.answered + phase.refused["decided, the answer lost"] == phase.asked, told
