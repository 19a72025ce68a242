import base64

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac.signatures import is_valid, is_valid_head, read_public_key, show_public_key, sign, sign_head

KEY = Ed25519PrivateKey.generate()
PUBLIC = KEY.public_key()
P = 2**255 - 19
SMALL_ORDER = [
    "0000000000000000000000000000000000000000000000000000000000000000",
    "0100000000000000000000000000000000000000000000000000000000000000",
    "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05",
    "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a",
    "ecffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
    "edffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
    "eeffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
]


@pytest.mark.parametrize("sign_bit", [0, 0x80])
@pytest.mark.parametrize("raw", SMALL_ORDER)
def test_points_of_small_order_are_no_keys(raw, sign_bit):
    point = bytearray.fromhex(raw)
    point[31] |= sign_bit
    with pytest.raises(ValueError, match=r"small order|Ed25519"):
        read_public_key(base64.b64encode(point).decode())


def test_a_key_reads_back_as_it_is_shown():
    assert read_public_key(show_public_key(KEY)) == PUBLIC


def test_a_signature_counts_for_what_it_names_and_nothing_else():
    named = ("s", "car-1", 3, "ab" * 32)
    signature = sign(KEY, *named)
    assert is_valid(PUBLIC, *named, signature)
    others = [("t", *named[1:]), ("s", "car-2", *named[2:]), ("s", "car-1", 4, named[3]), (*named[:3], "cd" * 32)]
    assert not any(is_valid(PUBLIC, *other, signature) for other in others)
    assert not is_valid(Ed25519PrivateKey.generate().public_key(), *named, signature)


def test_a_promise_is_no_message():
    promise = sign_head(KEY, "s", 3, "ab" * 32)
    assert is_valid_head(PUBLIC, "s", 3, "ab" * 32, promise)
    assert not is_valid_head(PUBLIC, "s", 4, "ab" * 32, promise)
    assert not is_valid(PUBLIC, "s", "3", 3, "ab" * 32, promise)
