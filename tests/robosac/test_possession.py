import base64
import hashlib
import json

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed448 import Ed448PrivateKey
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from jwt.algorithms import ECAlgorithm, OKPAlgorithm

from robosac.possession import Call, ProofError, check_proof, make_proof, read_origin

KEY, OTHER = Ed25519PrivateKey.generate(), Ed25519PrivateKey.generate()
PATH, TOKEN, NOW = "/v1/sessions/5e/teammates/car-2", "a.b.c", 1_700_000_000.0
URL = f"https://gateway.example{PATH}"
CALL = Call("DELETE", PATH, TOKEN)
ATH = base64.urlsafe_b64encode(hashlib.sha256(TOKEN.encode()).digest()).rstrip(b"=").decode()


def jwk_of(key):
    return OKPAlgorithm.to_jwk(key.public_key(), as_dict=True)


def proof(key=KEY, algorithm="EdDSA", header=(), without=(), **claims):
    """A proof as the standard has it, but for some changes, made without `make_proof`."""
    said = {"jti": "one", "htm": "DELETE", "htu": URL, "iat": int(NOW), "ath": ATH, **claims}
    head = {"typ": "dpop+jwt", "jwk": jwk_of(KEY), **dict(header)}
    kept = {name: value for name, value in said.items() if name not in without}
    return jwt.encode(kept, key, algorithm, {name: value for name, value in head.items() if value is not None})


def with_payload(text):
    """A proof whose claims are this text."""
    head, _, _ = proof().split(".")
    body = base64.urlsafe_b64encode(text).rstrip(b"=").decode()
    signature = base64.urlsafe_b64encode(KEY.sign(f"{head}.{body}".encode())).rstrip(b"=").decode()
    return f"{head}.{body}.{signature}"


def test_a_proof_of_the_standard_counts():
    found = check_proof(proof(), KEY.public_key(), CALL, NOW)
    assert (found.proof_id, found.made_at) == ("one", NOW)


def test_what_is_made_counts_and_is_never_the_same():
    made = [make_proof(KEY, "DELETE", f"{URL}?a=b#c", TOKEN, NOW + 0.5) for _ in range(2)]
    found = [check_proof(one, KEY.public_key(), CALL, NOW) for one in made]
    assert found[0].proof_id != found[1].proof_id
    claims = jwt.decode(made[0], KEY.public_key(), algorithms=["EdDSA"], options={"verify_iat": False})
    assert claims["htu"] == URL
    assert claims["ath"] == ATH
    assert "d" not in jwt.get_unverified_header(made[0])["jwk"]


def test_no_name_or_password_of_a_url_gets_into_a_proof():
    made = make_proof(KEY, "DELETE", f"https://me:secret@gateway.example:8443{PATH}", TOKEN, NOW)
    assert jwt.decode(made, options={"verify_signature": False})["htu"] == f"https://gateway.example:8443{PATH}"


EC = generate_private_key(SECP256R1())
WRONG = {
    "no JWT": ("abc", "not a JWT"),
    "no ASCII": ("\xff.\xff.\xff", "not a JWT"),
    "empty": ("", "not a JWT"),
    "too long": (proof(note="x" * 4096), "4096 bytes"),
    "deep": (base64.urlsafe_b64encode(b"[" * 2500).decode() + ".e30.", "not a JWT"),
    "another type": (proof(header={"typ": "JWT"}), "typ must"),
    "no type": (proof(header={"typ": None}), "typ must"),
    "no algorithm": (proof("", "none"), "alg must"),
    "the key as a password": (proof("x" * 32, "HS256"), "alg must"),
    "another algorithm": (proof(EC, "ES256", {"jwk": ECAlgorithm.to_jwk(EC.public_key(), as_dict=True)}), "alg must"),
    "no jwk": (proof(header={"jwk": None}), "jwk must"),
    "a jwk of a wrong kind": (proof(header={"jwk": ["x"]}), "jwk must"),
    "a private jwk": (proof(header={"jwk": OKPAlgorithm.to_jwk(KEY, as_dict=True)}), "no private one"),
    "a key of one's own": (proof(OTHER, header={"jwk": jwk_of(OTHER)}), "not the key that the vehicle registered"),
    "another curve": (proof(Ed448PrivateKey.generate()), "signature"),
    "signed by another": (proof(OTHER), "signature"),
    "the key in another form": (proof(header={"jwk": {**jwk_of(KEY), "x": jwk_of(KEY)["x"] + "="}}), "registered"),
    "cut": (proof().rpartition(".")[0], "not a JWT"),
    "a critical extension": (proof(header={"crit": ["b64", "x"], "x": 1}), "not a JWT"),
    **{f"no {name}": (proof(without=name), f"{name} is missing") for name in ("jti", "htm", "htu", "iat", "ath")},
    "an id of a wrong kind": (proof(jti=7), "jti must"),
    "an empty id": (proof(jti=""), "jti must"),
    "a long id": (proof(jti="x" * 257), "jti must"),
    "half a character as an id": (proof(jti="\ud800"), "jti must"),
    "an id with a zero byte": (proof(jti="a\x00"), "jti must"),
    "an id that is no ASCII": (proof(jti="é"), "jti must"),
    "another method": (proof(htm="POST"), "htm must be DELETE"),
    "a method in small letters": (proof(htm="delete"), "htm must"),
    "another path": (proof(htu=URL[:-1] + "3"), "htu must"),
    "a longer path": (proof(htu=URL + "/x"), "htu must"),
    "a path of nowhere": (proof(htu=PATH), "htu must"),
    "another scheme": (proof(htu=URL.replace("https", "ftp")), "htu must"),
    "no URL": (proof(htu="https://[x" + PATH), "htu must"),
    "no port": (proof(htu=f"https://gateway.example:99999{PATH}"), "htu must"),
    "a URL of a wrong kind": (proof(htu=[URL]), "htu must"),
    "another token": (proof(ath=ATH[:-1] + "A"), "ath must"),
    "a hash of a wrong kind": (proof(ath=[ATH]), "ath must"),
    "old": (proof(iat=int(NOW) - 71), "iat is more than 60 s ago"),
    "of the future": (proof(iat=int(NOW) + 11), "iat is in the future"),
    "a time of a wrong kind": (proof(iat=str(int(NOW))), "iat must"),
    "a truth for a time": (proof(iat=True), "iat must"),
    "NaN": (proof(iat=float("nan")), "iat must"),
    "for ever": (proof(iat=float("inf")), "iat is in the future"),
    "never": (proof(iat=float("-inf")), "iat is more than"),
    "over": (proof(exp=NOW - 10), "exp is in the past"),
    "not yet": (proof(nbf=NOW + 11), "nbf is in the future"),
    "over at a time of a wrong kind": (proof(exp="1"), "exp must"),
    "not before NaN": (proof(nbf=float("nan")), "nbf must"),
    "a huge time": (proof(iat=10**400), "iat is in the future"),
    "a list of claims": (with_payload(b"[1]"), "claims"),
    "a deep claim": (with_payload(b"{" + b'"a":[' * 400), "claims"),
}


@pytest.mark.parametrize("name", WRONG)
def test_every_other_proof_is_refused_and_it_is_said_why(name):
    text, why = WRONG[name]
    with pytest.raises(ProofError, match=why):
        check_proof(text, KEY.public_key(), CALL, NOW)


@pytest.mark.parametrize("age", [-10, 0, 0.5, 70])
def test_clocks_may_be_a_little_apart(age):
    assert check_proof(proof(iat=NOW - age), KEY.public_key(), CALL, NOW).made_at == NOW - age


def test_members_that_the_standard_allows_besides_do_no_harm():
    more = proof(
        header={"jwk": {**jwk_of(KEY), "kid": "k", "use": "sig"}, "kid": "k"}, exp=NOW + 1, nbf=NOW, aud="x", sub=7
    )
    assert check_proof(more, KEY.public_key(), CALL, NOW).proof_id == "one"


@pytest.mark.parametrize(
    "htu",
    [
        URL + "?x=1",
        URL + "#x",
        URL.replace("https://gateway.example", "http://10.0.0.1:8000"),
        URL.replace("/v1", "/behind/a/proxy/v1"),
        URL.replace("car-2", "car%2D2"),
    ],
)
def test_a_proxy_in_front_may_have_another_name_and_prefix(htu):
    check_proof(proof(htu=htu), KEY.public_key(), CALL, NOW)


@pytest.mark.parametrize(
    ("public_url", "htu", "good"),
    [
        ("https://Gateway.example", URL, True),
        ("https://gateway.example:443/", URL, True),
        ("https://gateway.example", URL.replace("https", "http"), False),
        ("https://gateway.example:8443", URL, False),
        ("https://other.example", URL, False),
        ("https://gateway.example", URL.replace("/v1", "/p/v1"), False),
        ("https://gateway.example/p/", URL.replace("/v1", "/p/v1"), True),
        ("https://gateway.example/p", URL, False),
    ],
)
def test_where_the_gateways_address_is_known_a_proof_has_to_name_it(public_url, htu, good):
    if good:
        check_proof(proof(htu=htu), KEY.public_key(), CALL, NOW, public_url)
    else:
        with pytest.raises(ProofError, match=f"htu must be {public_url.rstrip('/')}{PATH}"):
            check_proof(proof(htu=htu), KEY.public_key(), CALL, NOW, public_url)


@pytest.mark.parametrize("url", ["", "gateway.example", "ftp://gateway.example", "https://", "https://x:y", "/v1"])
def test_an_address_is_an_http_url(url):
    with pytest.raises(ValueError, match=r"."):
        read_origin(url)


def test_a_proof_is_remembered_for_as_long_as_any_gateway_takes_it():
    found = check_proof(proof(), KEY.public_key(), CALL, NOW)
    slow = found.ends_at - 10 + 0.001  # by the clock of a gateway that is as far behind as may be
    with pytest.raises(ProofError, match="ago"):
        check_proof(proof(), KEY.public_key(), CALL, slow)


def test_the_header_is_the_one_of_the_standard():
    head = json.loads(base64.urlsafe_b64decode(make_proof(KEY, "GET", URL, TOKEN).split(".")[0] + "=="))
    assert head == {"typ": "dpop+jwt", "alg": "EdDSA", "jwk": jwk_of(KEY)}
