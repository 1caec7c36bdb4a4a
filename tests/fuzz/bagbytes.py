"""What the targets for bags share: how bytes are damaged, and what must hold of a log that is read."""

from __future__ import annotations

import random
import struct
from pathlib import Path

__all__ = ["check_bag", "damage"]

_SIZES = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)


def damage(data: bytes, dice: random.Random, rule: bytes = b"") -> bytes:
    """A neighbour of some bytes: a number replaced, a part removed, doubled or cut off.

    Where they are parts with rules between them, of one of the parts.
    """
    if rule and rule in data:
        parts = data.split(rule)
        which = dice.randrange(len(parts))
        parts[which] = damage(parts[which], dice)
        return rule.join(parts)
    out = bytearray(data)
    for _ in range(dice.choice((1, 1, 2, 3))):
        if not out:
            break
        at = dice.randrange(len(out))
        what = dice.randrange(6)
        if what == 0:
            out[at] = dice.randrange(256)
        elif what == 1:
            width, form = dice.choice(((1, "<B"), (2, "<H"), (4, "<I"), (8, "<Q"), (4, ">I")))
            limit = (1 << (8 * width)) - 1
            out[at : at + width] = struct.pack(form, min(dice.choice(_SIZES), limit))
        elif what == 2:
            del out[at : at + dice.choice((1, 4, 8, dice.randrange(1, 200)))]
        elif what == 3:
            out[at:at] = out[at : at + dice.choice((4, 8, dice.randrange(1, 200)))]
        elif what == 4:
            del out[at if dice.random() < 0.2 else len(out) - min(len(out), 64) :]
        else:
            other = dice.randrange(len(out))
            out[at : at + 8] = out[other : other + 8]
    return bytes(out)


def check_bag(path: Path) -> None:
    """The rows of a bag are the same in blocks and as a whole, and all of them have a time."""
    import numpy as np

    from calib.io.logs import iter_log, log_text, read_log

    log = read_log(path)
    assert np.isfinite(log.t_s).all() and len(log) > 0
    blocks = list(iter_log(path))
    assert np.array_equal(np.concatenate([block.t_s for block in blocks]), log.t_s)
    for name, values in log.columns.items():
        assert not np.isinf(values).any(), name
    assert log_text(log).count("\n") == len(log) + 1
