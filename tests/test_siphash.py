"""SipHash-2-4 against its published vectors and an independent implementation.

The firmware hashes one prefix byte and then the bytes; both together are the message here.
"""

from hypothesis import example, given
from hypothesis import strategies as st

from headway.firmware import _core

KEY = bytes(range(16))
MASK = (1 << 64) - 1

# Aumasson and Bernstein, "SipHash: a fast short-input PRF", 2012, reference implementation
# (github.com/veorq/SipHash, vectors.h): key 00 .. 0f, message 00 .. n-1, for n = 0 .. 63.
VECTORS = bytes.fromhex("""
310e0edd47db6f72 fd67dc93c539f874 5a4fa9d909806c0d 2d7efbd796666785
b7877127e09427cf 8da699cd64557618 cee3fe586e46c9cb 37d1018bf50002ab
6224939a79f5f593 b0e4a90bdf82009e f3b9dd94c5bb5d7a a7ad6b22462fb3f4
fbe50e86bc8f1e75 903d84c02756ea14 eef27a8e90ca23f7 e545be4961ca29a1
db9bc2577fcc2a3f 9447be2cf5e99a69 9cd38d96f0b3c14b bd6179a71dc96dbb
98eea21af25cd6be c7673b2eb0cbf2d0 883ea3e395675393 c8ce5ccd8c030ca8
94af49f6c650adb8 eab8858ade92e1bc f315bb5bb835d817 adcf6b0763612e2f
a5c91da7acaa4dde 716595876650a2a6 28ef495c53a387ad 42c341d8fa92d832
ce7cf2722f512771 e37859f94623f3a7 381205bb1ab0e012 ae97a10fd434e015
b4a31508beff4d31 81396229f0907902 4d0cf49ee5d4dcca 5c73336a76d8bf9a
d0a704536ba93e0e 925958fcd6420cad a915c29bc8067318 952b79f3bc0aa6d4
f21df2e41d4535f9 87577519048f53a9 10a56cf5dfcd9adb eb75095ccd986cd0
51a9cb9ecba312e6 96afadfc2ce666c7 72fe52975a4364ee 5a1645b276d592a1
b274cb8ebf87870a 6f9bb4203de7b381 eaecb2a30b22a87f 9924a43cc1315724
bd838d3aafbf8db7 0b1a2a3265d51aea 135079a3231ce660 932b2846e4d70666
e1915f5cb1eca46c f325965ca16d629f 575ff28e60381be5 724506eb4c328a95
""")


def published(size: int) -> int:
    return int.from_bytes(VECTORS[8 * size : 8 * size + 8], "little")


def rotl(x: int, bits: int) -> int:
    return (x << bits | x >> (64 - bits)) & MASK


def siphash(key: bytes, message: bytes) -> int:
    """The paper's section 2, in unbounded integers and whole words."""
    k0, k1 = int.from_bytes(key[:8], "little"), int.from_bytes(key[8:], "little")
    initial = (b"somepseu", b"dorandom", b"lygenera", b"tedbytes")
    v = [int.from_bytes(w, "big") ^ k for w, k in zip(initial, (k0, k1, k0, k1), strict=True)]

    def rounds(n: int) -> None:
        for _ in range(n):
            v[0], v[2] = (v[0] + v[1]) & MASK, (v[2] + v[3]) & MASK
            v[1], v[3] = rotl(v[1], 13) ^ v[0], rotl(v[3], 16) ^ v[2]
            v[0] = rotl(v[0], 32)
            v[2], v[0] = (v[2] + v[1]) & MASK, (v[0] + v[3]) & MASK
            v[1], v[3] = rotl(v[1], 17) ^ v[2], rotl(v[3], 21) ^ v[0]
            v[2] = rotl(v[2], 32)

    padded = message + bytes(7 - len(message) % 8) + bytes([len(message) % 256])
    for i in range(0, len(padded), 8):
        word = int.from_bytes(padded[i : i + 8], "little")
        v[3] ^= word
        rounds(2)
        v[0] ^= word
    v[2] ^= 0xFF
    rounds(4)
    return v[0] ^ v[1] ^ v[2] ^ v[3]


def test_published_vectors() -> None:
    for size in range(1, 64):  # the empty message has no prefix byte
        assert _core.siphash24(KEY, 0, bytes(range(1, size))) == published(size), size


def test_oracle_agrees_with_the_published_vectors() -> None:
    assert len(VECTORS) == 64 * 8
    for size in range(64):
        assert siphash(KEY, bytes(range(size))) == published(size), size


@given(
    st.binary(min_size=16, max_size=16),
    st.integers(0, 255),
    st.binary(max_size=40) | st.binary(min_size=240, max_size=270),
)
@example(KEY, 255, bytes(254))  # the length byte is 255, 0, 1
@example(KEY, 255, bytes(255))
@example(KEY, 255, bytes(256))
@example(b"\xff" * 16, 255, b"\xff" * 1012)
def test_any_key_prefix_and_length(key: bytes, prefix: int, message: bytes) -> None:
    assert _core.siphash24(key, prefix, message) == siphash(key, bytes([prefix]) + message)
