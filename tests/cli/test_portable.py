# SPDX-License-Identifier: Apache-2.0
"""What keeps the package from being tied to one system. The rules of Windows are tested on any: they are functions."""

from __future__ import annotations

import ast
import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
import pytest
from calls import noted, python, raising, refuses
from models import random_gaussians
from packaging.requirements import Requirement
from quick import quick

from clsplat import process
from clsplat.cli.parsing import _unboxed
from clsplat.device.drivers import quirks
from clsplat.device.drivers.quirks import driver_advice
from clsplat.evaluation.held_out import picture_names
from clsplat.files import atomic
from clsplat.files.names import identity, name_trouble
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.scenes.readers import transforms
from clsplat.scenes.sfm import photos as sfm_photos
from clsplat.shots import frame_numbers

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = sorted((ROOT / "clsplat").rglob("*.py"))
LETTERS = "Zwölf Bäume 日本"
"""Of a folder: a space, letters that cp1252 has, and some that it lacks."""


REFUSED = (
    *("../a", "a/../../b", "..\\a", "C:/a", "C:a", "\\\\server\\share\\a", "/a", "", ".", "a\0b", "a.", "a /b", "a\nb"),
    *("ab:c", "a?", 'a"b', "a|b", "a*", "<a>", "con", "CON", "nul.png", "sub/Aux.x.png", "com1", "LPT9.jpg", "COM¹"),
    *("CONIN$", "nul .png"),
)
TAKEN = ("a", "sub/a.b c", "console", "null", "com", "com10", "a.con", "日本", ".a", "a,b;c=d+e")


@pytest.mark.parametrize("name", REFUSED)
def test_names_that_windows_refuses(name: str) -> None:
    assert name_trouble(name, windows=True)


@pytest.mark.parametrize("name", TAKEN)
def test_names_that_every_system_takes(name: str) -> None:
    assert name_trouble(name, windows=True) is None
    assert name_trouble(name, windows=False) is None


@pytest.mark.parametrize("name", ["C:a", "a?", "con", "a.", "a\\b", "..\\a"])
def test_names_that_windows_alone_refuses(name: str) -> None:
    assert name_trouble(name, windows=False) is None


@pytest.mark.parametrize(("name", "why"), [("..\\..\\x.jpg", "leads out"), ("nul.jpg", "device"), ("a?.jpg", "has")])
def test_a_frame_is_not_written_where_windows_would_not(name: str, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_numbers, "name_trouble", partial(name_trouble, windows=True))
    refuses(why, frame_numbers.output_paths, "out/{name}.png", [(1, name)])


def test_frames_that_differ_in_case_or_spelling_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = [("A.jpg", "a.jpg"), ("\u00fc.jpg", "u\u0308.jpg")]  # the second: as macOS used to spell it
    for pair in pairs:
        cameras = list(enumerate(pair))
        monkeypatch.setattr(frame_numbers, "identity", partial(identity, ignores_case=False))
        assert len(frame_numbers.output_paths("{name}.png", cameras)) == 2
        monkeypatch.setattr(frame_numbers, "identity", partial(identity, ignores_case=True))
        refuses("would be the file of both", frame_numbers.output_paths, "{name}.png", cameras)


def test_held_out_renders_that_would_be_one_file_where_case_is_ignored() -> None:
    assert picture_names(["IMG.jpg", "img.png", "b.png"]) == ["IMG.jpg.png", "img.png.png", "b.png"]


LISTED = (
    *("images/a.png", "./images/a.png", "images\\a.png", "../x/../images/a.png", "C:\\images\\a.png"),
    *("c:/images//a.png", "//images/a.png", "/images/a.png"),
)


@pytest.mark.parametrize("listed", LISTED)
def test_a_view_is_named_without_its_drive(listed: str) -> None:
    """A render is written under the view's name in the run's test/: with a drive it would be beside the photograph."""
    name = transforms._plain(listed)
    assert name == "images/a.png"
    for path in (PurePosixPath(name), PureWindowsPath(name)):
        assert not path.anchor
    run = PureWindowsPath("D:/run/test")
    assert (run / name).is_relative_to(run)


def test_a_file_that_another_program_has_open_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    left = [PermissionError(errno.EACCES, "The process cannot access the file")] * 3
    tries: list[int] = []

    def act() -> None:
        tries.append(1)
        if left:
            raise left.pop()

    with pytest.raises(PermissionError):
        atomic._retry_on_windows(act, windows=False)
    assert len(tries) == 1
    atomic._retry_on_windows(act, windows=True)
    assert len(tries) == 4
    monkeypatch.setattr(atomic, "WINDOWS_RETRY_SECONDS", 0.05)
    never = raising(PermissionError(errno.EACCES, "in use"))
    refuses("in use", atomic._retry_on_windows, never, windows=True, error=PermissionError)


def test_what_is_flushed_may_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows flushes no file that was opened for reading."""
    fcntl = pytest.importorskip("fcntl", reason="tells how a file was opened, on POSIX")
    pytest.importorskip("av", reason="the extra `video` brings it")
    from clsplat.images.video import frame_planes, video_writer

    asked = []

    def as_windows(descriptor: int) -> None:
        asked.append(descriptor)
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")

    noted(monkeypatch, os, "fsync", as_windows)
    with video_writer(tmp_path / "a.mp4") as video:
        video.add(frame_planes(np.zeros((32, 32, 3), np.float32)))
    assert asked
    asked.clear()
    atomic.atomic_write(tmp_path / "a", b"a")  # its folder is not flushed there, which is all that it loses
    assert asked
    assert (tmp_path / "a").read_bytes() == b"a"


def test_a_read_only_photo_is_copied_on_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link to it could not be removed again."""
    photos, target = tmp_path / "photos", tmp_path / "staged"
    photos.mkdir()
    write_image(photos / "a.png", np.zeros((4, 4, 3), np.float32))
    asked = []

    def access(path: Path, mode: int) -> bool:
        asked.append((path, mode))
        return False

    monkeypatch.setattr(sfm_photos, "ON_WINDOWS", True)
    monkeypatch.setattr(os, "access", access)
    sfm_photos.stage_photos(photos, [photos / "a.png"], target, lambda _: None, 1)
    assert asked == [(photos / "a.png", os.W_OK)]
    assert (target / "a.png").stat().st_nlink == 1
    assert (target / "a.png").read_bytes() == (photos / "a.png").read_bytes()


def test_processes_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 512, raising=False)
    assert process.apart() == {"creationflags": 512}
    monkeypatch.setattr(sys, "platform", "darwin")
    assert process.apart() == {"start_new_session": True}


def test_signals_that_ask_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(signal, "SIGBREAK", raising=False)
    hangup = (signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()
    handlers = {signal.SIGTERM: signal.SIG_DFL, 21: signal.SIG_DFL, **dict.fromkeys(hangup, signal.SIG_DFL)}
    monkeypatch.setattr(signal, "getsignal", handlers.__getitem__)
    assert process.endings() == (signal.SIGTERM, *hangup)
    monkeypatch.setattr(signal, "SIGBREAK", 21, raising=False)
    assert process.endings() == (signal.SIGTERM, *hangup, 21)
    handlers.update(dict.fromkeys(hangup, signal.SIG_IGN))
    assert process.endings() == (signal.SIGTERM, 21), "nohup has its way"


def test_a_reader_that_has_gone() -> None:
    invalid = OSError(errno.EINVAL, "Invalid argument")
    assert process.reader_has_gone(BrokenPipeError(errno.EPIPE, "Broken pipe"), windows=False)
    assert process.reader_has_gone(invalid, windows=True)
    assert not process.reader_has_gone(invalid, windows=False)
    assert not process.reader_has_gone(OSError(errno.EINVAL, "Invalid argument", "model.ply"), windows=True)
    assert not process.reader_has_gone(OSError(errno.ENOSPC, "No space left on device"), windows=True)


@pytest.mark.parametrize(
    ("system", "machine", "parts"),
    [
        ("Linux", "x86_64", ("pip install 'pyopencl[pocl]'", "GPU")),
        ("Linux", "aarch64", ("apt install pocl-opencl-icd", "GPU")),
        ("FreeBSD", "amd64", ("your distribution's PoCL",)),
        ("Windows", "AMD64", ("pip install intel-opencl-rt", "GPU")),
        ("Windows", "ARM64", ("GPU",)),
        ("Darwin", "arm64", ("conda install pyopencl pocl",)),
        ("Darwin", "x86_64", ("conda install pyopencl pocl",)),
    ],
)
def test_advice_where_there_is_no_driver(system: str, machine: str, parts: tuple[str, ...]) -> None:
    advice = driver_advice(system, machine)
    assert all(part in advice for part in parts)
    assert "\n" not in advice
    assert not advice.endswith(".")
    # what pip cannot install there is not advised
    assert ("pyopencl[pocl]" in advice) == ((system, machine) == ("Linux", "x86_64"))
    assert ("intel-opencl-rt" in advice) == ((system, machine) == ("Windows", "AMD64"))


def test_advice_is_of_this_system_unless_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.system", lambda: "Darwin")
    assert driver_advice() == driver_advice("Darwin", "arm64")


def test_the_loader_is_told_of_intels_driver(tmp_path: Path) -> None:
    offer: Callable[[dict[str, str]], None] = lambda given: quirks.offer_packaged(  # noqa: E731
        windows=True, prefix=str(tmp_path), environment=given
    )
    found: dict[str, str] = {}
    offer(found)
    assert found == {}
    library = tmp_path / "Library" / "bin" / "intelocl64.dll"
    library.parent.mkdir(parents=True)
    library.touch()
    offer(found)
    assert found == {"OCL_ICD_FILENAMES": str(library)}
    mine = {"OCL_ICD_FILENAMES": ""}
    offer(mine)
    assert mine == {"OCL_ICD_FILENAMES": ""}
    quirks.offer_packaged(windows=False, prefix=str(tmp_path), environment=(elsewhere := {}))
    assert elsewhere == {}


def test_each_system_gets_the_driver_that_pip_has_for_it() -> None:
    document = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    wanted = [Requirement(text) for text in document["project"]["dependencies"]]

    def drivers(platform: str, machine: str) -> set[str]:
        environment = {"sys_platform": platform, "platform_machine": machine}
        taken = [each for each in wanted if each.marker is None or each.marker.evaluate(environment)]
        assert "pyopencl" in {each.name for each in taken}
        named = {f"{each.name}[{extra}]" for each in taken for extra in each.extras}
        return named | {each.name for each in taken if each.name.startswith("intel")}

    assert drivers("linux", "x86_64") == {"pyopencl[pocl]"}
    assert drivers("win32", "AMD64") == {"intel-opencl-rt"}
    for platform, machine in (("linux", "aarch64"), ("darwin", "arm64"), ("darwin", "x86_64"), ("win32", "ARM64")):
        assert drivers(platform, machine) == set()


LACKING = """
import importlib, os, pkgutil, signal, sys
import clsplat

def load():
    names = [each.name for each in pkgutil.walk_packages(clsplat.__path__, "clsplat.")]
    for name in names:
        try:
            if name != "clsplat.__main__":
                importlib.import_module(name)
        except ModuleNotFoundError as error:
            assert error.name in ("jax", "torch"), name  # of extras that may not be there
    return names

def use():
    from clsplat.cli.main import main

    for arguments in (["--help"], ["train", "--help"], ["info", sys.argv[1]], ["convert", sys.argv[1], sys.argv[2]]):
        assert main(arguments) == 0, arguments

load()
use()  # now all libraries are there, which are those of this system
os.remove(sys.argv[2])
for name in [name for name in sys.modules if name.partition(".")[0] == "clsplat"]:
    del sys.modules[name]
for name in ("SIGHUP", "SIGKILL", "SIGALRM", "SIGUSR1", "SIGQUIT", "SIGCHLD", "SIGPIPE", "setitimer", "alarm", "pause"):
    delattr(signal, name)
for name in (
    "fork", "forkpty", "geteuid", "getuid", "getpgid", "setsid", "killpg", "chown", "mkfifo", "statvfs", "sysconf",
    "uname", "wait4", "WNOHANG", "O_CLOEXEC", "sched_getaffinity", "getloadavg", "nice", "posix_fallocate", "fchmod",
):
    delattr(os, name)
for name in ("fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"):
    sys.modules[name] = None
import clsplat

assert len(load()) > 100
use()
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="takes away what only POSIX has")
def test_no_module_wants_what_only_posix_has(tmp_path: Path) -> None:
    random_gaussians(4).save(tmp_path / "a.ply")
    done = python("-c", LACKING, tmp_path / "a.ply", tmp_path / "b.splat", encoding="utf-8", timeout=120)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "b.splat").stat().st_size == 4 * 32


ASCII_FILES = {"clsplat/device/drivers/shapes.py", "clsplat/selftest/worker.py"}
"""These read what json.dumps wrote, which is ASCII."""


def test_every_text_has_its_encoding_and_no_process_is_forked() -> None:
    found, asked = [], 0
    for path in (*PACKAGE, ROOT / "tools/environment.py", ROOT / "tools/demo", ROOT / "tools/test"):
        file = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            place = f"{file}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [each.name for each in node.names]
                if {name.partition(".")[0] for name in names} & {"multiprocessing", "fcntl", "resource", "pwd", "grp"}:
                    found.append(f"{place}: imports {names}")
            if not isinstance(node, ast.Call) or file in ASCII_FILES:
                continue
            called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            if called in ("read_text", "write_text") or (called == "open" and isinstance(node.func, ast.Name)):
                asked += 1
                words = [each.value for each in node.args if isinstance(each, ast.Constant)]
                text = called != "open" or not any("b" in str(word) for word in words)
                named = "utf-8" in words or any(each.arg == "encoding" for each in node.keywords)
                if text and not named:
                    found.append(f"{place}: {called} without an encoding")
    assert asked > 10
    assert found == []


def run_clsplat(folder: Path, environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "clsplat", *arguments]
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH", ""))))
    whole = {**os.environ, "PYTHONPATH": path, **environment}
    return subprocess.run(command, cwd=folder, env=whole, capture_output=True, timeout=120, check=False)


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
LOCALES = {"C": {"LC_ALL": "C"}, "C without Python's own help": ASCII, "cp1252": {"PYTHONIOENCODING": "cp1252"}}


@pytest.mark.slow
@pytest.mark.parametrize("locale", LOCALES)
def test_paths_of_any_letters_in_any_locale(locale: str, tmp_path: Path) -> None:
    folder = tmp_path / LETTERS
    folder.mkdir()
    random_gaussians(4, 1).save(folder / "Größe 日.ply")
    done = run_clsplat(folder, LOCALES[locale], "convert", "Größe 日.ply", "日ü.sog")
    assert (done.returncode, b"Traceback" in done.stderr) == (0, False), done
    assert (folder / "日ü.sog").is_file()
    done = run_clsplat(folder, LOCALES[locale], "info", "日ü.sog")  # its pictures are read by OpenImageIO
    assert (done.returncode, done.stderr) == (0, b""), done
    done = run_clsplat(folder, LOCALES[locale], "info", "ä日.ply")
    assert done.returncode == 2
    assert done.stderr.startswith(b"clsplat: error: ")
    assert done.stderr.count(b"\n") == 1


def test_a_picture_in_a_folder_of_any_letters_where_the_locale_is_ascii(tmp_path: Path) -> None:
    folder = tmp_path / LETTERS
    folder.mkdir()
    code = "import sys, numpy as np; from pathlib import Path; from clsplat.images.reading import read_image; "
    code += "from clsplat.images.writing import write_image; "
    code += "write_image(Path(sys.argv[1]), np.ones((2, 3, 3), np.float32)); assert read_image(Path(sys.argv[1])).all()"
    environment = {**os.environ, **ASCII, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, "日ü.png"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert read_image(folder / "日ü.png").shape == (2, 3, 3)


@pytest.mark.parametrize("verb", ["", "train", "render"])
def test_help_where_output_is_cp1252(verb: str, tmp_path: Path) -> None:
    done = run_clsplat(tmp_path, {"PYTHONIOENCODING": "cp1252"}, *verb.split(), "--help")
    assert done.returncode == 0, done.stderr
    assert b"usage: clsplat" in done.stdout
    assert done.stderr == b""
    done.stdout.decode("cp1252")


@pytest.mark.parametrize("encoding", quick(["cp1252", "ascii", "UTF-8"], "ascii"))
def test_a_table_and_a_warning_where_output_lacks_the_letters(encoding: str, tmp_path: Path) -> None:
    folder = tmp_path / LETTERS
    folder.mkdir()
    random_gaussians(4, 2).save(folder / "日.ply")
    with (folder / "日.ply").open("ab") as file:
        file.write(b"more")  # a warning
    environment = {"PYTHONIOENCODING": encoding}
    target = str(Path(LETTERS) / "日本.splat")
    done = run_clsplat(tmp_path, environment, "convert", str(Path(LETTERS) / "日.ply"), target)
    assert (done.returncode, b"Traceback" in done.stderr) == (0, False), done
    shown = target.encode(encoding, "backslashreplace").decode(encoding)
    assert f"\n{shown}: splat" in done.stdout.decode(encoding).replace("\r\n", "\n")
    warned = done.stderr.decode(encoding)
    assert warned.startswith(f"clsplat: warning: {LETTERS.encode(encoding, 'backslashreplace').decode(encoding)}")
    assert len(warned.splitlines()) == 1


@pytest.mark.parametrize("encoding", quick(["cp1252", "utf-8", "UTF-8"], "cp1252"))
def test_a_wrong_call_is_one_short_line_whatever_the_encoding(encoding: str, tmp_path: Path) -> None:
    """tyro frames its report by the encoding of standard output."""
    environment = {"PYTHONIOENCODING": encoding}
    done = run_clsplat(tmp_path, environment, "train", "s", "-o", "r", "--iterations", "abc")
    line = b"clsplat: error: Error parsing --iterations: invalid literal for int() with base 10: 'abc'"
    assert (done.returncode, done.stdout, done.stderr.splitlines()) == (2, b"", [line])
    done = run_clsplat(tmp_path, environment, "nonsense")
    assert done.stderr.splitlines() == [b"clsplat: error: Unrecognized options: nonsense"]


def test_frames_of_reports() -> None:
    plain = " Value error\n ---------\n  Error parsing it\n  of -- two lines\n  -------\n  For full helptext\n   \n"
    boxed = (
        "╭─ Value error ─╮\n│ Error parsing it │\n│ of -- two lines │\n│ ──────── │\n│ For full helptext │\n╰────╯\n"
    )
    assert _unboxed(plain) == _unboxed(boxed) == "Error parsing it of -- two lines"


def test_pyopencl_is_imported_in_one_room() -> None:
    """Its first import needs a variable and a signal's handler: `clsplat/device/__init__.py` sees to both."""
    names = [
        path.relative_to(ROOT).as_posix()
        for path in PACKAGE
        if "import pyopencl" in path.read_text("utf-8") and "device" not in path.parts
    ]
    assert names == []
