"""YAML, JSON, arrays and files of every kind as strangers have them: what is read, and what is refused in one line."""

from __future__ import annotations

import errno
import gzip
import io
import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from dsom_jax.data import files
from dsom_jax.data.documents import parse_json, read_toml, read_yaml
from dsom_jax.data.files import MB, check_file, read_arrays, read_bytes, read_lines
from dsom_jax.errors import LONGEST, UserError, one_line, shown


def yaml_of(folder: Path, text: str | bytes) -> dict:
    path = folder / "some.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_yaml(path, "map yaml")


@pytest.mark.parametrize(
    ("text", "value"),
    [("5e-2", 0.05), ("5", 5), ("-.5", -0.5), ("1.", 1.0), (".inf", np.inf), ("-.INF", -np.inf), ("true", True),
     ("null", None), ("", None), ("yes", "yes"), ("010", "010"), ("0x10", "0x10"), ("1_000", "1_000"),
     ("1:30", "1:30"), ("2020-13-45", "2020-13-45"), ("'5'", "5"), ("!!str 5", "5"), ("!!float 5", 5.0),
     ("[1, [2.5, a]]", [1, [2.5, "a"]]),
     ("{0: 1, b: {c: 2}}", {"0": 1, "b": {"c": 2}}), ("1e400", np.inf), ("é", "é")],
)  # fmt: skip
def test_yaml_is_what_json_could_say(tmp_path, text, value):
    read = yaml_of(tmp_path, f"a: {text}")["a"]
    assert read == value and type(read) is type(value)


def test_aliases_and_merged_fields(tmp_path):
    read = yaml_of(tmp_path, "a: &a {x: 1, y: 2}\nb: *a\nc: {<<: *a, y: 3}\n")
    assert read == {"a": {"x": 1, "y": 2}, "b": {"x": 1, "y": 2}, "c": {"x": 1, "y": 3}}


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 8)}]\n" for n in range(1, 30)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: " + 5000 * "9", "line 1: a number of 5000 digits"),
        ("a: " + 400 * "9", "line 1: a number of 400 digits"),
        ("a: 1\nb: 2\na: 3", "line 3: field 'a' stands twice"),
        (BOMB, "values"),
        ("a: " + 1000 * "[" + 1000 * "]", "line 1: more than 24 levels"),
        (100_000 * "[", "more than 24 levels"),
        (100_000 * "{a: ", "more than 24 levels"),
        ("a: &a [*a]", "names nothing"),
        ("a: *b", "names nothing"),
        ("a: !!bool maybe", "'maybe' is no bool"),
        ("a: !!int ''", "is no int"),
        ("a: !!timestamp 2020-13-45", "tag '.*timestamp' is not read"),
        ("a: !!python/object/apply:os.system [ls]", "tag .* is not read"),
        ("a: !!binary x", "tag .* is not read"),
        ("a: 1\n---\nb: 2", "several documents"),
        ("? [1, 2]\n: 3", "a list as the name of a field"),
        ("a: \x00", "not valid YAML"),
        ("a: \x1b[31m", "not valid YAML"),
        (b"a: \xe9", "not text in UTF-8"),
        ("a: 1".encode("utf-16"), "not text in UTF-8"),
        ("a:" + MB * " ", "larger than 1 MB, the limit for a map yaml"),
        ("[1]", "holds no fields"),
    ],
    ids=lambda part: str(part)[:20],
)
def test_yaml_that_is_refused(tmp_path, text, message):
    with pytest.raises(UserError, match=f"some.yaml: .*{message}") as error:
        yaml_of(tmp_path, text)
    assert len(str(error.value)) <= LONGEST and str(error.value).isprintable()


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "line 1"), ("[" * 100_000, "deep|levels"), ("[" * 100 + "]" * 100, "levels"), ("9" * 5000, "not JSON"),
     ("9" * 400, "400 digits"), ('{"a": 1, "a": 2}', "'a' stands twice"), ("", "not JSON"), ("\0", "not JSON")],
    ids=lambda part: str(part)[:20],
)  # fmt: skip
def test_json_that_is_refused(text, message):
    with pytest.raises(UserError, match=f"run.json: .*({message})"):
        parse_json(text, "run.json")


def test_json_and_toml(tmp_path):
    assert parse_json('{"a": [1, null, 2.5]}', "x") == {"a": [1, None, 2.5]}
    (tmp_path / "a.toml").write_text("a = 1\n[b]\nc = [1.5]\n")
    assert read_toml(tmp_path / "a.toml", "suite") == {"a": 1, "b": {"c": [1.5]}}
    for text in ("a = " + "9" * 400, "a = " + "[" * 5000, "a = 2020-13-45", "a = 1\na = 2"):
        (tmp_path / "a.toml").write_text(text)
        with pytest.raises(UserError, match=r"a\.toml: "):
            read_toml(tmp_path / "a.toml", "suite")


def test_what_is_no_regular_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    os.symlink("loop", tmp_path / "loop")
    cases = [("/dev/zero", "a device or a pipe"), (tmp_path / "pipe", "a device or a pipe"), (tmp_path, "a directory"),
             (tmp_path / "none", "no such log"), (tmp_path / "loop", "cannot read"), ("a" * 300, "300 characters"),
             ("a\0b", "no file has such a name")]  # fmt: skip
    for path, message in cases:
        for read in (read_bytes, check_file):
            with pytest.raises(UserError, match=message) as error:
                read(path, "log")
            assert str(error.value).isprintable()


def test_what_may_not_be_read(tmp_path, monkeypatch):
    def refuse(path, *rest):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(UserError, match=r"cannot read the log .Permission denied.; check its permissions"):
        read_bytes(tmp_path / "log", "log")


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n", "git-LFS pointer.*git lfs pull"),
     (b"/annex/objects/SHA256-s1--0\n", "git-annex pointer"), (b"<!DOCTYPE html><html>", "web page")],
)  # fmt: skip
def test_what_stands_for_a_file_is_named(tmp_path, content, message):
    (tmp_path / "map.pgm").write_bytes(content)
    for read in (read_bytes, check_file):
        with pytest.raises(UserError, match=f"map.pgm: is a.*{message}"):
            read(tmp_path / "map.pgm", "map image")


def test_size_is_limited_and_named(tmp_path):
    (tmp_path / "big").write_bytes(bytes(1001))
    assert len(read_bytes(tmp_path / "big", "log", 1001)) == 1001
    with pytest.raises(UserError, match=r"larger than 0.001 MB, the limit for a log"):
        read_bytes(tmp_path / "big", "log", 1000)


def test_lines_and_what_unpacks_to_too_many(tmp_path, monkeypatch):
    path = tmp_path / "a.log"
    for text in (b"one\ntwo\r\nthree", gzip.compress(b"one\ntwo\nthree\n")):
        path.write_bytes(text)
        assert read_lines(path, "log") == ["one", "two", "three"]
    path.write_bytes(gzip.compress(bytes(3 * MB), 1))
    with pytest.raises(UserError, match="line 1 is one too many or too long"):
        read_lines(path, "log")
    path.write_bytes(gzip.compress(MB * b"a bc\n"))
    with pytest.raises(UserError, match="unpacks to more than a log holds"):
        read_lines(path, "log")
    path.write_bytes(gzip.compress(1000 * b"a b\n")[:-20])
    with pytest.raises(UserError, match="broken gzip file"):
        read_lines(path, "log")
    monkeypatch.setattr(files, "LINES", 3)
    path.write_bytes(b"a\n" * 4)
    with pytest.raises(UserError, match="line 4 is one too many"):
        read_lines(path, "log")


def test_arrays_are_bounded_and_hold_no_objects(tmp_path):
    stored = io.BytesIO()
    np.savez_compressed(stored, a=np.arange(3), b=np.zeros((2, 2)))
    content = stored.getvalue()
    (tmp_path / "a.npz").write_bytes(content)
    assert read_arrays(tmp_path / "a.npz", "table")["a"].tolist() == [0, 1, 2]
    with pytest.raises(UserError, match="unpacks to"):
        read_arrays(content, "table", most=100)
    rng = np.random.default_rng(0)
    for n in range(300):
        spoilt = bytearray(content)
        for at in rng.integers(len(content), size=4):
            spoilt[at] = rng.integers(256)
        try:
            read_arrays(bytes(spoilt), f"table {n}")
        except UserError as error:
            assert f"table {n}" in str(error)
    np.savez(stored := io.BytesIO(), a=np.array([{}], object))
    huge = io.BytesIO()
    with zipfile.ZipFile(huge, "w") as archive:
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000,), }".ljust(117) + b"\n"
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00\x76\x00" + header)
    for wrong in (stored.getvalue(), huge.getvalue(), b"not a zip", b""):
        with pytest.raises(UserError, match="table: not readable"):
            read_arrays(wrong, "table")


def test_messages_are_one_short_line_that_a_terminal_can_take():
    message = str(UserError("map\x1b[2J.yaml:\n wrong\t" + "x" * 1000 + " fix it\u202e"))
    assert message.startswith("map\\x1b[2J.yaml: wrong xxx") and message.endswith("fix it\\u202e")
    assert len(message) <= LONGEST and message.isprintable()
    assert one_line("caf\u00e9 \udcff") == "caf\u00e9 \\udcff"


@pytest.mark.parametrize(
    "value", [10**5000, "x" * 1000, [[["deep"] * 9] * 9] * 9, {n: n for n in range(99)}, {1, 2}],
    ids=["digits", "text", "lists", "fields", "set"])  # fmt: skip
def test_values_are_shown_briefly(value):
    assert len(shown(value)) <= 120
    json.dumps(shown(value))
