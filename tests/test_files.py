"""Files: either the old one or the whole new one, whatever goes wrong and whenever, and the error says which file."""

import contextlib
import errno
import json
import os
import resource
import stat
import sys
from pathlib import Path

import pytest

from armsight import files
from armsight.errors import InputError, nearest
from armsight.files import (
    RowFile,
    alone_in,
    check_folder,
    check_readable,
    check_writable,
    read_json,
    read_table,
    read_text,
    read_toml,
    replacing,
    write_text,
)
from armsight.vision.image import read_image

SMALL, LARGE = "new\n", "new\n" * 100_000  # within one buffer, and many of them


def write(contents, flush=False):
    """Write several files, each open until all are written; an error among the texts is raised."""
    with contextlib.ExitStack() as stack:
        opened = [(stack.enter_context(replacing(path)), texts) for path, texts in contents.items()]
        for file, texts in opened:
            for text in texts:
                if isinstance(text, Exception):
                    raise text
                file.write(text)
                if flush:
                    file.flush()


@contextlib.contextmanager
def room(size):
    """Let no file grow beyond a size: the kernel refuses the write, as it does on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("mode", ["w", "wb"])
@pytest.mark.parametrize("old", [None, "old\n"])
@pytest.mark.parametrize("content", ["", SMALL, LARGE])
def test_the_file_is_whole(tmp_path, mode, old, content):
    path = tmp_path / "file.txt"
    if old is not None:
        path.write_text(old)
    with replacing(path, mode) as file:
        file.write(content if mode == "w" else content.encode())
        assert path.exists() == (old is not None)
    assert path.read_text() == content
    assert os.listdir(tmp_path) == ["file.txt"]


def test_text_is_utf8_and_names_that_are_no_text_are_escaped(tmp_path):
    path = tmp_path / "µ.txt"
    write_text(path, "0.1 µm \udce9\n")  # \udce9 is how Python holds a byte 0xe9 of a file name that is not UTF-8
    assert path.read_bytes() == "0.1 µm \\udce9\n".encode()
    assert read_text(path) == "0.1 µm \\udce9\n"


def test_the_users_mask_sets_the_permissions(tmp_path):
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "file", SMALL)
    finally:
        os.umask(before)
    assert stat.S_IMODE(os.stat(tmp_path / "file").st_mode) == 0o640


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there" / "file")
    write_text(tmp_path / "link", SMALL)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there" / "file").read_text() == SMALL
    assert os.listdir(tmp_path / "there") == ["file"]


@pytest.mark.parametrize("old", [None, "old\n"])
@pytest.mark.parametrize("pieces", [1, 100])
@pytest.mark.parametrize("size", [0, 3, 200_000])
def test_a_disk_without_room_is_reported_with_the_file_and_leaves_what_was(tmp_path, old, pieces, size):
    path = tmp_path / "file.txt"
    if old is not None:
        path.write_text(old)
    with room(size), pytest.raises(InputError) as caught:
        write({path: [LARGE[: len(LARGE) // pieces]] * pieces})
    assert str(caught.value) == f"{path}: cannot be written: File too large"
    assert [p.read_text() for p in tmp_path.iterdir()] == ([] if old is None else [old])


def test_no_space_is_reported(tmp_path, monkeypatch):
    def write(self, data):
        with self._named():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files._NamedFile, "write", write)
    with pytest.raises(InputError) as caught:
        write_text(tmp_path / "file", SMALL)
    assert str(caught.value) == f"{tmp_path / 'file'}: cannot be written: No space left on device"
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("full", ["first", "second"])
@pytest.mark.parametrize("content", [SMALL * 100, LARGE])
@pytest.mark.parametrize("flush", [False, True])
def test_nested_files_are_each_reported_by_name(tmp_path, full, content, flush):
    contents = {tmp_path / name: [content if name == full else SMALL] for name in ("first", "second")}
    with room(300), pytest.raises(InputError, match=f"{full}: cannot be written: File too large"):
        write(contents, flush)
    # What is small and not flushed shows its trouble only on closing, when the second file already stands.
    late = full == "first" and content != LARGE and not flush
    assert os.listdir(tmp_path) == (["second"] if late else [])


@pytest.mark.parametrize(
    "error", [OSError("no name, no number"), OSError(errno.ENODEV, "gone"), ValueError("no number")]
)
def test_errors_of_other_things_pass_through(tmp_path, error):
    with pytest.raises(type(error)) as caught:
        write({tmp_path / "file": [SMALL, error]})
    assert caught.value is error
    assert os.listdir(tmp_path) == []


def test_errors_of_other_files_keep_their_name(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, replacing(tmp_path / "file"):
        (tmp_path / "other").read_text()
    assert caught.value.filename == str(tmp_path / "other")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("where", ["nowhere/file", "nowhere/deeper/file", "text/file"])
def test_a_missing_folder_is_reported(tmp_path, where):
    (tmp_path / "text").write_text("no folder")
    with pytest.raises(InputError) as caught:
        write_text(tmp_path / where, SMALL)
    folder = (tmp_path / where).parent
    assert str(caught.value) == f"{tmp_path / where}: cannot be written: there is no folder {folder}; make it first"
    with pytest.raises(InputError, match="there is no folder"):
        check_writable(tmp_path / where)
    assert os.listdir(tmp_path) == ["text"]


def test_a_folder_or_a_device_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name, kind in (("", "folder"), ("pipe", "device")):
        with pytest.raises(InputError, match=f"cannot be written: it is a {kind}; give the name of a file"):
            write_text(tmp_path / name, SMALL)
        with pytest.raises(InputError, match=f"cannot be written: it is a {kind}; give the name of a file"):
            check_writable(tmp_path / name)
    with pytest.raises(InputError, match="it is a device"):
        write_text("/dev/null", SMALL)
    assert os.listdir(tmp_path) == ["pipe"]


def test_a_folder_without_permission_is_reported(tmp_path, monkeypatch):
    check_writable(tmp_path / "file")
    assert os.listdir(tmp_path) == []
    monkeypatch.setattr(files.os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(InputError, match=f"file: cannot be written: no permission to write in {tmp_path}"):
        check_writable(tmp_path / "file")


def test_a_folder_that_refuses_is_reported(forbidden):
    with pytest.raises(InputError, match="file: cannot be written: Permission denied"):
        write_text(forbidden / "file", SMALL)


def test_a_name_that_is_too_long_is_reported(tmp_path):
    with pytest.raises(InputError, match="cannot be written: File name too long"):
        write_text(tmp_path / ("x" * 256), SMALL)


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "no such file"), (b"\xff\xfe\x00\xd8", "not a text file"), (..., "cannot be read: it is a folder")],
)
def test_reading_says_what_is_wrong(tmp_path, content, said):
    path = tmp_path / "file"
    if content is ...:
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=f"file: {said}"):
        read_text(path)


@pytest.mark.parametrize("read", [read_text, read_table, read_json, read_toml, check_readable, read_image])
def test_what_is_no_ordinary_file_of_bounded_size_is_rejected_at_once(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for path, kind in (("/dev/zero", "a device"), (tmp_path / "pipe", "a pipe"), (tmp_path, "a folder")):
        with pytest.raises(InputError, match=f"cannot be read: it is {kind}; give the name of a file"):
            read(path)
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(6_000_000_000)  # of which the disk holds nothing
    with pytest.raises(InputError, match=r"huge: has 6000 MB, such a file at most \d+ MB"):
        check_readable(tmp_path / "huge", 8) if read is check_readable else read(tmp_path / "huge")


def test_a_file_that_says_no_size_and_has_no_end_is_rejected(tmp_path, monkeypatch):
    (tmp_path / "grows").write_bytes(b"1" * 9_000_000)
    size_of = os.fstat
    monkeypatch.setattr(files.os, "fstat", lambda n: os.stat_result((*size_of(n)[:6], 0, *size_of(n)[7:])))
    with pytest.raises(InputError, match="grows: has 9 MB, such a file at most 8 MB"):
        read_text(tmp_path / "grows")


@pytest.mark.parametrize(
    ("read", "text", "said"),
    [
        (read_json, "[" * 100_000, "nested too deep"),
        (read_toml, "a = " + "[" * 5_000, "nested too deep"),
        (read_json, '{"a": 1,\n}', "line [12]: not JSON"),
        (read_toml, "a = " + "1" * 10_000, "not TOML"),
        (read_toml, "a = " + "1" * 100_001, "more than 100000 digits"),  # tomllib takes 120 bytes for each
        (read_toml, "# " + "_" * 100_001, "a run of more than 100000 digits or letters a to f"),  # may be no number
        (read_table, "1," * 600_000, "a line of more than 1000000 characters"),
        (read_table, "1\n" * 2_500_001, "more than 5000000 cells up to line 2500001"),
    ],
)
def test_what_would_take_too_much_memory_or_stack_is_one_line(tmp_path, read, text, said):
    (tmp_path / "file").write_text(text)
    with pytest.raises(InputError, match=f"file: .*{said}") as caught:
        read(tmp_path / "file")
    assert "\n" not in str(caught.value)


def test_a_whole_number_of_many_digits_is_one_that_float_can_take(tmp_path):
    (tmp_path / "file").write_text("1" * 5_000)
    assert float(read_json(tmp_path / "file")) == float("inf")


def test_what_was_written_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(files.os, "fsync", lambda number: done.append(os.readlink(f"/proc/self/fd/{number}")))
    monkeypatch.setattr(files.os, "replace", lambda old, new: done.append(str(new)))
    write_text(tmp_path / "file", SMALL)
    assert [Path(each).name.split(".")[1:2] or Path(each).name for each in done] == [["file"], "file", tmp_path.name]


def test_rows_are_in_their_file_whole_or_not_at_all(tmp_path):
    path, link = tmp_path / "poses.csv", tmp_path / "link.csv"
    path.write_text("old\n")
    link.symlink_to(path)
    with pytest.raises(InputError, match=r"poses\.csv: cannot be written: File exists"):
        RowFile(path, ("a", "b"))
    with room(2), pytest.raises(InputError, match=r"link\.csv: cannot be written"):
        RowFile(link, ("a", "b"), replaces=True)
    assert (link.is_symlink(), path.exists()) == (True, True)
    rows = RowFile(link, ("a", "b"), replaces=True)
    rows.add(["x,y", 1.5])
    with room(18), pytest.raises(InputError, match=r"link\.csv: cannot be written"):
        rows.add(["another", 2.5])
    rows.add(["z", None])
    rows.close()
    assert (path.read_text(), rows.rows) == ('a,b\n"x,y",1.5\nz,\n', 2)


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps a file that is open")
def test_rows_for_a_file_that_was_deleted_are_an_error(tmp_path):
    rows = RowFile(tmp_path / "poses.csv", ("a",))
    rows.add((1,))
    rows.path.unlink()
    with pytest.raises(InputError, match=r"poses\.csv: cannot be written: it was deleted meanwhile"):
        rows.add((2,))
    assert rows.rows == 1


@pytest.mark.parametrize("name", ["table.csv", "Report.HTML"])
def test_a_folder_of_results_has_no_files_name(tmp_path, name):
    with pytest.raises(InputError, match=r"^/.*: several files come of it; give a folder, such as"):
        check_folder(tmp_path / name)
    (tmp_path / name).mkdir()
    assert check_folder(tmp_path / name) == tmp_path / name
    assert check_folder(tmp_path / "v1.2") == tmp_path / "v1.2"


def test_tables_are_read_as_cells(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text('\ufeffname,x\n"a, b",1\n\n"two\nlines",2\n', encoding="utf-8")
    assert read_table(path) == [["name", "x"], ["a, b", "1"], [], ["two\nlines", "2"]]
    path.write_text("x" * 200_000)
    with pytest.raises(InputError, match=r"table\.csv: not a table: field larger than field limit"):
        read_table(path)


def test_an_interrupt_anywhere_leaves_the_old_file_or_the_new_one(tmp_path):
    """Raise KeyboardInterrupt at the first line of files.py that runs, then at the second, and so on to the last."""
    path = tmp_path / "file.txt"
    moments = 0
    for moment in range(10**6):
        path.write_text("old\n")
        left = iter(range(moment, -1, -1))

        def trace(frame, event, arg, left=left):
            if frame.f_code.co_filename != files.__file__:
                return None if event == "call" else trace
            # In the clean-up of the clean-up one line is left that an interrupt must not hit.
            if event == "line" and "os.unlink" not in line_of(frame) and next(left, None) == 0:
                raise KeyboardInterrupt
            return trace

        sys.settrace(trace)
        try:
            write_text(path, LARGE)
        except KeyboardInterrupt:
            moments += 1
            assert path.read_text() in ("old\n", LARGE)
            assert os.listdir(tmp_path) == ["file.txt"]
        else:
            break
        finally:
            sys.settrace(None)
    assert moments > 20
    assert path.read_text() == LARGE


def line_of(frame):
    with open(files.__file__) as file:
        return file.read().splitlines()[frame.f_lineno - 1]


def test_a_real_full_disk(small_disk):
    disk = small_disk("64k")
    write_text(disk / "rig.json", json.dumps("old"))
    with pytest.raises(InputError) as caught:
        write_text(disk / "rig.json", LARGE)
    assert str(caught.value) == f"{disk / 'rig.json'}: cannot be written: No space left on device"
    assert read_text(disk / "rig.json") == json.dumps("old")
    assert os.listdir(disk) == ["rig.json"]


@pytest.mark.parametrize("mark", [";", "\t"])
def test_tables_of_spreadsheets_are_read(tmp_path, mark):
    path = tmp_path / "table.csv"
    path.write_text(f'name{mark}x_m{mark}note\na{mark}-0,25{mark}"1{mark}2"\nb{mark} 1,5e-3{mark}left, right\n')
    assert read_table(path) == [["name", "x_m", "note"], ["a", "-0.25", f"1{mark}2"], ["b", " 1.5e-3", "left, right"]]
    path.write_text(f"name{mark}x_m\na{mark}0.25\n")
    assert read_table(path) == [["name", "x_m"], ["a", "0.25"]]
    path.write_text(f"x{mark}y\n0,25{mark}1\n2{mark}0.5\n")
    with pytest.raises(InputError, match=r"table\.csv: line 3 has 0\.5 and line 2 0,25: .* decimal mark"):
        read_table(path)
    path.write_text(f"x,a{mark}b\n1,2\n")
    assert read_table(path) == [["x", f"a{mark}b"], ["1", "2"]]


def test_a_folder_is_for_one_process_of_a_command(tmp_path):
    with alone_in(tmp_path / "live", "live"):
        with pytest.raises(InputError, match="another live uses it: give this one another folder, -o FOLDER"):
            alone_in(tmp_path / "live", "live").__enter__()
        with pytest.raises(InputError, match="another live uses it"):
            alone_in(tmp_path / "live", "run").__enter__()
    assert not (tmp_path / "live").exists()  # nothing came to be in it
    with alone_in(tmp_path / "live", "hub"):
        (tmp_path / "live" / "events").touch()
    assert [each.name for each in (tmp_path / "live").iterdir()] == ["events"]
    (own := tmp_path / "own").mkdir()
    with alone_in(own, "run"):
        pass
    assert own.exists()  # nobody but its maker removes it


@pytest.mark.parametrize(("method", "error"), [("mkdir", FileExistsError), ("open", FileNotFoundError)])
def test_a_folder_that_another_process_is_just_removing_is_in_use(tmp_path, monkeypatch, method, error):
    def gone(*_, **__):
        raise error

    monkeypatch.setattr(type(tmp_path), method, gone)
    with pytest.raises(InputError, match="another run uses it"):
        alone_in(tmp_path / "x", "run").__enter__()


def test_the_nearest_of_many_names_also_where_one_is_a_number():
    assert nearest("3", [f"n{k}" for k in range(99)] + ["3"]) == "3 and 99 more"
    assert nearest(3, [f"n{k}" for k in range(99)] + ["3"]) == "3 and 99 more"


def test_names_that_are_not_near_are_listed_in_their_order():
    head = ["temp", *(f"j{k}" for k in range(1, 7)), "px", "py", "pz", "a", "b", "c", "u", "v"]
    assert nearest("x_m", head) == ", ".join(head)
    assert nearest("x_m", [*head, "w"]) == f"{', '.join(head)} and 1 more"
