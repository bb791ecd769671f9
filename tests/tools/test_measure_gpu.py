# SPDX-License-Identifier: Apache-2.0
"""tools/measure_gpu.py: parts that are made once, in a file that is whole after each; the search for a driver."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import measure_gpu
import numpy as np
import pinhole_pycolmap
import pycolmap
import pytest
from measure_gpu import Setting, find, libraries, measure, parts_of, starter


def setting(folder: Path, limit: float = 60.0) -> Setting:
    return Setting({"PATH": "/usr/bin"}, folder, "cpu", limit)


def test_a_part_is_made_once_and_the_file_is_whole_after_each(tmp_path: Path) -> None:
    file, made = tmp_path / "gpu.json", []

    def part(name: str, trouble: str = "") -> Any:
        def run(_: Setting) -> str:
            assert file.is_file() == bool(made)
            made.append(name)
            if trouble:
                raise RuntimeError(trouble)
            return name.upper()

        return run

    parts = {"a": part("a"), "b": part("b", "no such luck"), "c": part("c")}
    assert measure(file, setting(tmp_path), parts, []) == 1
    assert made == ["a", "b", "c"]
    results = json.loads(file.read_text())
    assert (results["a"]["result"], results["b"]["trouble"], results["c"]["result"]) == ("A", "no such luck", "C")
    assert measure(file, setting(tmp_path), {**parts, "b": part("b")}, []) == 0
    assert made == ["a", "b", "c", "b"], "what is there is not made again, and what failed is"
    assert measure(file, setting(tmp_path), parts, ["a"]) == 0
    assert made[4:] == ["a"]


def test_the_environment_that_find_found_holds_in_the_next_call(tmp_path: Path) -> None:
    file = tmp_path / "gpu.json"
    file.write_text(json.dumps({"find": {"result": {"environment": {"OCL_ICD_VENDORS": "there"}}}}))
    later: dict[str, str] = {}
    measure(file, setting(tmp_path), {"a": lambda given: later.update(given.environment)}, [])
    assert later["OCL_ICD_VENDORS"] == "there"


def test_the_gpus_own_library_comes_first(tmp_path: Path) -> None:
    for name in ("libRusticlOpenCL.so.1", "lib/libpocl.so.2", "driver/libnvidia-opencl.so.1"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = [path.name for _, path in libraries([str(tmp_path), str(tmp_path / "lib"), str(tmp_path / "none")])]
    assert names == ["libnvidia-opencl.so.1", "libpocl.so.2", "libRusticlOpenCL.so.1"]


@pytest.mark.parametrize("helps", [True, False])
def test_a_library_that_shows_a_gpu_is_named_to_the_loader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, helps: bool
) -> None:
    def devices(given: Setting) -> list[dict[str, Any]]:
        named = "OCL_ICD_VENDORS" in given.environment
        assert not named or (Path(given.environment["OCL_ICD_VENDORS"]) / "gpu.icd").read_text() == "/lib/libx.so\n"
        return [{"kind": "gpu" if named and helps else "cpu", "name": "a device"}]

    monkeypatch.setattr(measure_gpu, "_devices", devices)
    monkeypatch.setattr(measure_gpu, "libraries", lambda: [("the GPU's own driver", Path("/lib/libx.so"))])
    given = setting(tmp_path)
    result = find(given)
    assert result["tried"] == [{"kind": "the GPU's own driver", "library": "/lib/libx.so", "devices": ["a device"]}]
    assert ("OCL_ICD_VENDORS" in given.environment) is helps
    assert bool(result["environment"]) is helps


def test_a_part_that_takes_too_long_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "slow.py"
    script.write_text("import sys, time\ntime.sleep(60)\n")
    popen = subprocess.Popen
    monkeypatch.setattr(measure_gpu.subprocess, "Popen", lambda _, **rest: popen([sys.executable, str(script)], **rest))
    file = tmp_path / "gpu.json"
    assert measure(file, setting(tmp_path, limit=0.2), {"tune": parts_of([])["tune"]}, []) == 1
    assert json.loads(file.read_text())["tune"]["trouble"] == "clsplat tune took more than 0.2 s"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["gpu.json", "--scenes", "nowhere"], "no such folder, expected a scene"),
        (["gpu.json", "--parts", "sing"], "--parts: sing: expected of find, selftest"),
        (["none/gpu.json"], "no such folder, expected one for gpu.json"),
        ([], "the name of the JSON file is missing"),
    ],
)
def test_calls_that_make_no_sense(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ending:
        measure_gpu.main(words)
    assert ending.value.code == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("scenes", "words", "wanted"),
    [
        ((), (), ""),
        (("fox", "a scene"), (), "{top}/scenes/a scene,{top}/scenes/fox"),
        (("fox",), ("--scenes", "b"), "b"),
    ],
)
def test_the_script_of_an_archive(scenes: tuple[str, ...], words: tuple[str, ...], wanted: str, tmp_path: Path) -> None:
    """It writes the file into the folder that it is called in, and says nothing of its own."""
    top, called_in = tmp_path / "un packed" / "clsplat", tmp_path / "elsewhere"
    (top / "tools").mkdir(parents=True)
    called_in.mkdir()
    for scene in scenes:
        (top / "scenes" / scene).mkdir(parents=True)
    tool = "import os, sys; print(os.getcwd(), os.environ['PYTHONPATH'], *sys.argv[1:], sep='|')"
    (top / "tools" / "measure_gpu.py").write_text(tool)
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    (top / "measure").write_text(starter(version).replace(f"exec python{version}", f"exec {sys.executable}"))
    command = ["sh", "../un packed/clsplat/measure", "gpu.json", *words]
    done = subprocess.run(command, cwd=called_in, capture_output=True, text=True, check=True)
    folder, path, *got = done.stdout.strip().split("|")
    assert (folder, path, done.stderr) == (str(called_in), f"{top}/packages:{top}", "")
    assert got[-1 if "--scenes" in words else 1] == wanted.format(top=top) and "gpu.json" in got


def test_an_archive_that_lacks_a_package_is_told(tmp_path: Path) -> None:
    (tmp_path / "packages").mkdir()
    with pytest.raises(RuntimeError, match=r"packages of the archive are not enough: .*No module named 'clsplat'"):
        measure_gpu.check_imports(tmp_path)


@pytest.mark.parametrize(
    ("model", "params"), [("PINHOLE", (50.0, 60.0, 31.0, 23.5)), ("SIMPLE_PINHOLE", (55.0, 33.0, 24.0))]
)
def test_an_archives_cameras_are_those_of_pycolmap(model: str, params: tuple[float, ...]) -> None:
    given = {"model": model, "width": 64, "height": 48, "params": list(params)}
    here, there = pinhole_pycolmap.Camera(**given), pycolmap.Camera(**given)
    for name in ("focal_length_x", "focal_length_y", "principal_point_x", "principal_point_y"):
        assert getattr(here, name) == getattr(there, name)
    for name in ("focal_length_idxs", "principal_point_idxs", "extra_params_idxs"):
        assert list(getattr(here, name)()) == list(getattr(there, name)())
    assert int(pinhole_pycolmap.CameraModelId[model]) == int(pycolmap.CameraModelId.__members__[model])
    points = np.array([[0.3, -0.2, 2.0], [0.1, 0.4, -1.0], [-1.0, 0.5, 0.7]])
    # the same divisions and products in another order: some roundings of float64
    np.testing.assert_allclose(here.img_from_cam(points), there.img_from_cam(points), rtol=1e-14)
    with pytest.raises(ValueError, match="OPENCV: an archive without pycolmap has pinhole cameras alone"):
        pinhole_pycolmap.Camera("OPENCV", 64, 48, [])
