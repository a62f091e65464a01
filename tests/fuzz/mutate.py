"""Mutations of a file: of its bytes, of its words, and of what they mean (units, signs, frames, order)."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

Mutation = Callable[[np.random.Generator, bytes], bytes]
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
NASTY = (
    b"nan", b"inf", b"-inf", b".nan", b".inf", b"-.inf", b"0", b"-1", b"-0.0", b"1e300", b"-1e300", b"1e-300", b"1e154",
    b"3.4028235e38", b"2147483648", b"-9223372036854775809", b"9" * 400, b"9" * 5000, b"010", b"0x10", b"1_000",
    b"1:30", b"yes", b"null", b"~", b"''", b"'1'", b"[]", b"{}", b"[[[[1]]]]", b"true", b"90", b"360", b"6.2831853",
    b"1e400", b"2020-13-45", b"!!int ''", b"!!bool x", b"!!python/object:os.system x", b"&a [*a]", b"*a",
    b"\x00", b"\x1b[31m",
    b"\xff\xfe", b"\xe2\x80\xae", b"../../../etc/passwd", b"/dev/zero", b"/dev/stdin", b"a" * 300, b"{a: 1, a: 2}",
    b"30000", b"65536", b"1000000", b"1,5", b"1.5m",
)  # fmt: skip


def flip(rng: np.random.Generator, content: bytes) -> bytes:
    spoilt = bytearray(content)
    for at in rng.integers(len(spoilt), size=rng.integers(1, 9)):
        spoilt[at] = rng.integers(256)
    return bytes(spoilt)


def cut(rng: np.random.Generator, content: bytes) -> bytes:
    return content[: rng.integers(len(content))]


def drop(rng: np.random.Generator, content: bytes) -> bytes:
    first = int(rng.integers(len(content)))
    return content[:first] + content[first + int(rng.integers(1, 200)) :]


def double(rng: np.random.Generator, content: bytes) -> bytes:
    first, size = int(rng.integers(len(content))), int(rng.integers(1, 2000))
    return content[: first + size] + content[first : first + size] * int(rng.integers(1, 4)) + content[first + size :]


def insert(rng: np.random.Generator, content: bytes) -> bytes:
    at = int(rng.integers(len(content) + 1))
    return content[:at] + NASTY[rng.integers(len(NASTY))] + content[at:]


def number(rng: np.random.Generator, content: bytes) -> bytes:
    """One to three numbers become something else."""
    found = list(NUMBER.finditer(content))
    for match in sorted(
        (found[i] for i in set(rng.integers(len(found), size=rng.integers(1, 4)).tolist())), key=lambda m: -m.start()
    ) if found else ():
        content = content[: match.start()] + NASTY[rng.integers(len(NASTY))] + content[match.end() :]
    return content


def lines(rng: np.random.Generator, content: bytes) -> bytes:
    """Lines are left out, repeated, or change their order."""
    rows = content.split(b"\n")
    picked = int(rng.integers(len(rows)))
    match rng.integers(4):
        case 0:
            del rows[picked]
        case 1:
            rows.insert(picked, rows[picked])
        case 2:
            rng.shuffle(rows)
        case _:
            rows = rows[::-1]
    return b"\n".join(rows)


def value(rng: np.random.Generator, content: bytes) -> bytes:
    """What stands behind the colon, or equals sign, of a line becomes something else."""
    rows = content.split(b"\n")
    picked = [n for n, row in enumerate(rows) if re.match(rb"\s*\w+\s*[:=]", row)]
    if picked:
        n = picked[rng.integers(len(picked))]
        rows[n] = re.sub(rb"([:=]).*", lambda m: m[1] + b" " + NASTY[rng.integers(len(NASTY))], rows[n], count=1)
    return b"\n".join(rows)


def units(rng: np.random.Generator, content: bytes) -> bytes:
    """Every number of the file, or of one column, in another unit: millimetres, degrees, feet, the other sign."""
    factor = (1000.0, 0.001, 100.0, 57.29578, 0.0174533, 3.28084, -1.0, 1e9)[rng.integers(8)]
    column = None if rng.random() < 0.5 else int(rng.integers(12))
    rows = []
    for row in content.split(b"\n"):
        found = list(NUMBER.finditer(row))
        for n, match in reversed(list(enumerate(found))):
            if column is None or n == column:
                row = row[: match.start()] + f"{float(match[0]) * factor:.9g}".encode() + row[match.end() :]
        rows.append(row)
    return b"\n".join(rows)


def replace(rng: np.random.Generator, content: bytes) -> bytes:
    """Another file altogether."""
    return (
        b"", b"\x00" * 1000, b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
        b"<!DOCTYPE html><html></html>", b"\x1f\x8b\x08\x00broken", b"BZh9broken", rng.bytes(300), b"[" * 50_000,
        b"{" * 50_000, b"a: " * 20_000, b"P5\n30000 30000\n255\n" + bytes(99), b"P2\n9 9\n255\n" + b"9" * 5000,
        "ä: ö\n".encode("utf-16"), b"\xff" * 64, b"\n" * 5000, b"PK\x03\x04" + bytes(60), b"#ROSBAG V2.0\n" + bytes(60),
    )[rng.integers(17)]  # fmt: skip


MUTATIONS: tuple[Mutation, ...] = (flip, cut, drop, double, insert, number, number, lines, value, value, units, replace)


def mutate(rng: np.random.Generator, content: bytes) -> bytes:
    """One to three mutations in turn."""
    for pick in rng.integers(len(MUTATIONS), size=rng.choice([1, 1, 1, 2, 3])):
        content = MUTATIONS[pick](rng, content) or b""
        if not content:
            return content
    return content
