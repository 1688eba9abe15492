"""Only regular files below a stated size are opened."""

import os
import socket

import pytest
from posecore.files import open_regular, read_regular, require_regular, sha256_file

OPENERS = [lambda path: open_regular(path).close(), read_regular, require_regular, sha256_file]


@pytest.mark.parametrize("opened", OPENERS)
def test_what_is_no_regular_file_is_refused_without_being_read(tmp_path, opened):
    os.mkfifo(tmp_path / "pipe")  # opening it to read would wait for a writer
    (tmp_path / "link").symlink_to("pipe")
    reasons = {"/dev/zero": "a device", "/dev/null": "a device", tmp_path / "pipe": "a pipe", tmp_path: "a folder"}
    for path, kind in {**reasons, tmp_path / "link": "a pipe"}.items():
        with pytest.raises(OSError, match="expected a regular file") as caught:
            opened(path)
        assert caught.value.strerror == f"is {kind}, expected a regular file"
        assert caught.value.filename == str(path)


@pytest.mark.parametrize("opened", OPENERS)
def test_missing_files_and_impossible_names_are_os_errors(tmp_path, monkeypatch, opened):
    with pytest.raises(FileNotFoundError):
        opened(tmp_path / "none")
    for name in ("zero\0byte", "lone\ud800surrogate"):
        with pytest.raises(OSError, match="is a name that no file can have"):
            opened(tmp_path / name)
    with socket.socket(socket.AF_UNIX) as listening:
        monkeypatch.chdir(tmp_path)  # a socket has at most 108 characters
        listening.bind("socket")
        with pytest.raises(OSError, match="No such device"):
            opened(tmp_path / "socket")


def test_a_file_beyond_its_limit_is_refused_before_it_is_read(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"0123456789")
    assert read_regular(file, 10) == b"0123456789"
    with pytest.raises(OSError, match="has 10 bytes, expected at most 9"):
        read_regular(file, 9)
    with file.open("r+b") as stream:
        stream.truncate(1 << 40)  # sparse: takes no room, reading it would take all memory
    with pytest.raises(OSError, match="has 1099511627776 bytes, expected at most 2147483648"):
        read_regular(file)
    with open_regular(file, None) as stream:
        assert stream.read(10) == b"0123456789"


def test_a_name_that_is_not_utf8_is_a_name(tmp_path):
    name = os.fsencode(tmp_path) + b"/\xff\xfe.bin"
    with open(name, "wb") as stream:
        stream.write(b"content")
    assert read_regular(os.fsdecode(name)) == b"content"
