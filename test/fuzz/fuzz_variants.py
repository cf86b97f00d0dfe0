# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Variants of seeds: bytes changed, cut and repeated, and tokens that readers trip over."""

TOKENS = [
    *(b'', b'0', b'-0', b'1e160', b'-1e308', b'1e-320', b'nan', b'inf', b'0x' + b'f' * 5000),
    *(b'9' * 5000, '²'.encode(), '٣'.encode(), b'9223372036854775808', b'1:1:1', b'2001-99-99'),
    *(
        b'null',
        b'true',
        b'[]',
        b'{}',
        b'*a',
        b'&a [*a]',
        b'!!int ""',
        b'!!python/object:os.system',
    ),
    *(b'"', b"'", b'\n', b'\0', b'\xff', b'\xe2\x80\xa8', b'<!DOCTYPE', b'&amp;', b'%s', b'{0}'),
    *(b'[' * 1000, b'- ' * 1000, b'<a>' * 500, b'a' * 2000, b'\xff' * 8, b'\0' * 8, b','),
]


def variant(rng, seeds):
    """Return a seed with some places changed; a place is where a word ends more often than not."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, 6)):
        at, here = (rng.randint(0, len(data)) for _ in range(2))
        length = rng.randint(0, rng.choice([12, len(data) - at]))
        new = rng.choice([rng.choice(TOKENS), rng.randbytes(rng.randint(0, 12)), data[here:][:40]])
        if rng.random() < 0.5:  # a whole word
            begin = max(data.rfind(mark, 0, at) for mark in b',: \n"[')
            ends = [data.find(mark, at) for mark in b',: \n"]']
            at, length = begin + 1, min([e for e in ends if e >= 0] or [len(data)]) - begin - 1
        data[at : at + length] = new
    return bytes(data)
