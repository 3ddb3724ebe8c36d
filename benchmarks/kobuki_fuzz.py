"""Noise, torn and damaged frames through the Kobuki's decoder: what was sent, what came out, and whether it was right.

    python benchmarks/kobuki_fuzz.py --megabytes 10

The stream comes in pieces of random length, as from a serial port. `lost` are frames that were sent whole and did not
come out, because what came before them looked like the beginning of a longer one. `wrong` are readings that nobody
sent. The check sum of the protocol, an exclusive or, cannot notice two flips of the same bit of two bytes; a USB serial
adapter loses bytes, but does not flip any.
"""

from __future__ import annotations

import argparse
import random
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from csv_table import write_table

from relmm.robot.hardware.kobuki_protocol import Feedback, FrameReader, decode, frame

RESULTS = Path(__file__).parent / "results" / "kobuki_fuzz.csv"
SEED, MOST_AT_ONCE = 0, 300  # bytes of a piece

# A piece of the stream, the payload that its frame was made of, if there is one, and whether it must come out.
Piece = tuple[bytes, bytes | None, bool]


def payload(rng: random.Random) -> bytes:
    """What a base may tell, with every field at random."""
    basic = struct.pack(
        "<HBBBHHbbBBBB",
        *(rng.randrange(65_536), rng.randrange(8), rng.randrange(4), rng.randrange(8)),
        *(rng.randrange(65_536), rng.randrange(65_536), 0, 0),
        *(rng.randrange(8), rng.choice((0, 2, 6, 18, 22)), rng.randrange(130, 168), rng.randrange(4)),
    )
    inertia = struct.pack("<hh3x", rng.randrange(-18_000, 18_000), rng.randrange(-9000, 9000))
    gyro = bytes([13, 14, rng.randrange(256), 6]) + rng.randbytes(12)
    return bytes([1, 15]) + basic + bytes([4, 7]) + inertia + gyro


def whole(rng: random.Random) -> Piece:
    """A frame as it should be."""
    data = payload(rng)
    return frame(data), data, True


def noisy(rng: random.Random) -> Piece:
    """Nothing but noise, with many headers in it."""
    return b"".join(rng.choice((rng.randbytes(8), b"\xaa\x55", b"\xaa")) for _ in range(20)), None, False


def surrounded(rng: random.Random) -> Piece:
    """A whole frame after noise."""
    good, data, _ = whole(rng)
    return noisy(rng)[0] + good, data, True


def torn(rng: random.Random) -> Piece:
    """The beginning of a frame. What it tells may come out, if what follows happens to complete it."""
    good, data, _ = whole(rng)
    return good[: rng.randrange(1, len(good))], data, False


def damaged(rng: random.Random) -> Piece:
    """A frame with some bits flipped."""
    bad = bytearray(whole(rng)[0])
    for _ in range(rng.randrange(1, 4)):
        bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
    return bytes(bad), None, False


def mixed(rng: random.Random) -> Piece:
    """Any of these, but for flipped bits."""
    return rng.choice((whole, whole, noisy, surrounded, torn))(rng)


KINDS: dict[str, Callable[[random.Random], Piece]] = {
    "whole frames": whole,
    "noise only": noisy,
    "noise between frames": surrounded,
    "torn frames": torn,
    "all of these": mixed,
    "flipped bits": damaged,
}


def pieces(stream: bytes, rng: random.Random) -> Iterator[bytes]:
    """The stream in pieces of any length."""
    start = 0
    while start < len(stream):
        end = start + rng.randrange(1, MOST_AT_ONCE)
        yield stream[start:end]
        start = end


def fuzz(kind: str, size: int) -> dict[str, Any]:
    """A row of the table: `size` bytes of one kind."""
    rng = random.Random(f"{SEED} {kind}")
    made, length = [], 0
    while length < size:
        made.append(KINDS[kind](rng))
        length += len(made[-1][0])
    sent = Counter(decode(data) for _, data, comes in made if data is not None and comes)
    true = Counter(decode(data) for _, data, _ in made if data is not None)
    reader, received = FrameReader(), Counter[Feedback | None]()
    start = time.process_time()
    for piece in pieces(b"".join(data for data, _, _ in made), rng):
        received.update(map(decode, reader.feed(piece)))
    seconds = time.process_time() - start
    del received[None]  # a frame that tells nothing about the base
    return {
        "kind": kind,
        "bytes": length,
        "sent": sent.total(),
        "received": received.total(),
        "lost": (sent - received).total(),
        "wrong": (received - true).total(),
        "seconds": round(seconds, 1),
    }


def main() -> None:
    """Fuzz, print the table, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=10.0, help="of all kinds together")
    arguments = parser.parse_args()
    rows = [fuzz(kind, round(arguments.megabytes * 1e6 / len(KINDS))) for kind in KINDS]
    for row in rows:
        print(", ".join(f"{key} {value}" for key, value in row.items()))
    write_table(rows, RESULTS)


if __name__ == "__main__":
    main()
