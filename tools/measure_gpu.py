#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Measurements of a GPU in parts of at most eight minutes, in one JSON file that is written after every part.

    python tools/measure_gpu.py gpu.json [--scenes FOLDER,...] [--parts find,selftest,...] [--device gpu]
    python tools/measure_gpu.py --pack gpu.tar.xz [--scenes FOLDER,...]

A part that is in the file is not made again, unless --parts names it; a training that does not end in its time goes on
the next time. Parts: find (OpenCL and its devices: where no device is a GPU, the driver's own library is looked for and
named to the loader, else PoCL's for CUDA, else Rusticl over Zink), selftest, digests (against those of a CPU), tune,
bench-235k, bench-1m, bench-3m, and for each scene train-NAME (7000 steps, held-out PSNR, 1080p frames a second) and
gsplat-NAME, where gsplat is installed.

--pack makes an archive for a machine without a package index: this checkout, the packages that are installed here
without tests and debugging symbols, in place of pycolmap one for pinhole cameras alone, and the scenes. There:
tar xf gpu.tar.xz && sh clsplat/measure gpu.json.
Exit status 0: all parts are there, 1: a part failed, 2: the call is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LIMIT = 8 * 60
"""Seconds of a part."""
STEPS = 7000
PACK_LIMIT = 55_000_000
"""Bytes of an archive."""
LEFT_OUT = (
    *("pycolmap", "pocl-binary-distribution", "intel-opencl-rt"),
    *("imageio", "markdown-it-py", "networkx", "pillow", "pygments", "tifffile", "zstandard"),
)
"""Packages that an archive goes without: structure from motion, drivers for CPUs, and what the parts never import: it
serves formats that are not measured, and what else rich and scikit-image can do."""
PARTS_USED = {
    "scipy": (
        "_lib",
        "constants",
        "fft",
        "interpolate",
        "linalg",
        "ndimage",
        "optimize",
        "sparse",
        "spatial",
        "special",
    ),
    "skimage": ("_shared", "_vendored", "exposure", "metrics", "util"),
}
"""Folders of large packages that the parts import; an archive goes without the others."""
IMPORTS = (
    "clsplat.api",
    "clsplat.cli.train",
    "clsplat.evaluation.metrics",
    "clsplat.bench.stages",
    "clsplat.images.writing",
)
"""Modules that a whole archive can import, before it is written."""
LIBRARIES = {
    "the GPU's own driver": ("libnvidia-opencl.so*", "libamdocl64.so*", "libigdrcl.so*"),
    "PoCL": ("libpocl.so*",),
    "Rusticl over Zink": ("libRusticlOpenCL.so*",),
}
"""Names of drivers' libraries, the best first."""
FOLDERS = ("/usr/lib", "/usr/lib64", "/usr/lib/x86_64-linux-gnu", "/usr/local/nvidia/lib64", "/usr/local/lib", "/opt")
SIZES = {
    "bench-235k": (235_000, "1024x768"),
    "bench-1m": (1_000_000, "1600x1060"),
    "bench-3m": (3_000_000, "1600x1060"),
}


@dataclass(frozen=True)
class Setting:
    """The setting that all parts share: environment of their processes, folder of runs, device, seconds of a part."""

    environment: dict[str, str]
    runs: Path
    device: str
    limit: float


def call(setting: Setting, *words: str) -> subprocess.CompletedProcess[str]:
    """Run `clsplat` with these words for at most the part's time; SIGTERM then, so that a training writes a checkpoint.
    Raises TimeoutError where it was ended, and RuntimeError with the last line of its errors where it failed."""
    command = [sys.executable, "-m", "clsplat", *words]
    with subprocess.Popen(
        command, env=setting.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            out, error = process.communicate(timeout=setting.limit)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGTERM)
            try:
                process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                process.kill()
            raise TimeoutError(f"clsplat {words[0]} took more than {setting.limit:g} s") from None
    if process.returncode:
        lines = error.strip().splitlines() or [f"status {process.returncode}"]
        raise RuntimeError(f"clsplat {words[0]}: {lines[-1]}")
    return subprocess.CompletedProcess(command, 0, out, error)


def parsed(setting: Setting, *words: str) -> Any:
    """The JSON that a verb prints."""
    return json.loads(call(setting, *words, "--json").stdout)


def libraries(folders: Sequence[str] = FOLDERS) -> Iterator[tuple[str, Path]]:
    """Drivers' libraries below these folders, by kind, the best kind first; each file once."""
    for kind, patterns in LIBRARIES.items():
        seen = set()
        for folder in folders:
            for pattern in patterns:
                for path in sorted(Path(folder).rglob(pattern)) if Path(folder).is_dir() else ():
                    if path.resolve() not in seen:
                        seen.add(path.resolve())
                        yield kind, path


def find(setting: Setting) -> dict[str, Any]:
    """The devices; where none is a GPU, those that a library shows which is named to the loader. That stays so for the
    parts that follow."""
    devices = _devices(setting)
    tried = []
    if not any(device["kind"] == "gpu" for device in devices):
        vendors = setting.runs / "drivers"
        shutil.rmtree(vendors, ignore_errors=True)
        vendors.mkdir(parents=True)
        before = dict(setting.environment)
        for kind, library in libraries():
            (vendors / "gpu.icd").write_text(f"{library}\n")
            setting.environment.update(OCL_ICD_VENDORS=str(vendors), RUSTICL_ENABLE="zink", POCL_DEVICES="cuda")
            shown = _devices(setting)
            tried.append({"kind": kind, "library": str(library), "devices": [info["name"] for info in shown]})
            if any(info["kind"] == "gpu" for info in shown):
                devices = shown
                break
        else:
            setting.environment.clear()
            setting.environment.update(before)
    names = ("OCL_ICD_VENDORS", "RUSTICL_ENABLE", "POCL_DEVICES")
    kept = {name: setting.environment[name] for name in names if name in setting.environment}
    system = {"system": platform.platform(), "python": platform.python_version(), "driver": _nvidia()}
    return {"devices": devices, "tried": tried, "environment": kept, **system}


def _devices(setting: Setting) -> list[dict[str, Any]]:
    try:
        devices: list[dict[str, Any]] = parsed(setting, "devices")
    except (RuntimeError, TimeoutError):
        return []
    return devices


def _nvidia() -> str:
    """The line of nvidia-smi about GPUs and driver, or nothing."""
    command = ["nvidia-smi", "--query-gpu=name,driver_version,clocks.max.sm,clocks.max.mem", "--format=csv,noheader"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=30, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""


def selftest(setting: Setting) -> dict[str, Any]:
    """The report of a bug, whether it has one or not."""
    report = setting.runs / "selftest.json"
    try:
        call(setting, "selftest", "--device", setting.device, "--report", str(report), "--overwrite")
    except RuntimeError:
        if not report.is_file():
            raise
    result: dict[str, Any] = json.loads(report.read_text())
    return result


def digests(setting: Setting) -> dict[str, Any]:
    """Digests of the self-test's stages that are not those of a CPU. They are stored with the package."""
    stored = json.loads((ROOT / "clsplat" / "selftest" / "digests.json").read_text())["digests"]
    (device,) = selftest(setting)["devices"]
    lanes, items = (int(word) for word in re.findall(r"[0-9]+", device["shape"]))
    label = f"{lanes}x{items}{'g' if 'by Gaussian' in device['shape'] else ''}"
    wanted = {name: value.get(label) if isinstance(value, dict) else value for name, value in stored.items()}
    return {"shape": label, "other": sorted(name for name, value in device["digests"].items() if value != wanted[name])}


def tune(setting: Setting) -> Any:
    """The shapes and their times."""
    return parsed(setting, "tune", "--device", setting.device)


def bench(gaussians: int, size: str) -> Callable[[Setting], Any]:
    """A part that measures the stages of a made-up scene."""
    words = ("bench", "--gaussians", str(gaussians), "--size", size)
    return lambda setting: parsed(setting, *words, "--device", setting.device)


def train(scene: Path) -> Callable[[Setting], Any]:
    """A part that trains a scene to STEPS and renders it at 1080p. It goes on with what an earlier call left."""

    def part(setting: Setting) -> Any:
        run = setting.runs / scene.name
        begun = (run / "checkpoints").is_dir() and any((run / "checkpoints").iterdir())
        resume = ("--resume",) if begun else ("--overwrite",)
        start = time.monotonic()
        words = (str(scene), "-o", str(run), "--iterations", str(STEPS), "--checkpoint-every", "1000", *resume)
        evaluation = parsed(setting, "train", *words, "--device", setting.device)
        seconds = time.monotonic() - start
        frame = parsed(setting, "bench", str(run / "model.ply"), "--size", "1920x1080", "--device", setting.device)
        rate = 1000 / frame["frame_ms"]
        return {"evaluation": evaluation, "last_call_seconds": seconds, "frames_a_second": rate, "bench": frame}

    return part


def gsplat(scene: Path) -> Callable[[Setting], Any]:
    """A part that says which gsplat there is; its trainer's command is run where it lies beside the scene, as
    gsplat.sh."""

    def part(setting: Setting) -> Any:
        try:
            version = metadata.version("gsplat")
        except metadata.PackageNotFoundError:
            return {"left_out": "gsplat is not installed"}
        script = scene / "gsplat.sh"
        if not script.is_file():
            return {
                "version": version,
                "left_out": f"no {script.name} in {scene.name}, which trains it to {STEPS} steps",
            }
        start = time.monotonic()
        result = subprocess.run(
            ["sh", str(script)], cwd=scene, capture_output=True, text=True, timeout=setting.limit, check=True
        )
        return {"version": version, "seconds": time.monotonic() - start, "output": result.stdout[-2000:]}

    return part


def parts_of(scenes: Sequence[Path]) -> dict[str, Callable[[Setting], Any]]:
    """All parts by name, in order."""
    parts: dict[str, Callable[[Setting], Any]] = {"find": find, "selftest": selftest, "digests": digests, "tune": tune}
    parts |= {name: bench(*size) for name, size in SIZES.items()}
    for scene in scenes:
        parts |= {f"train-{scene.name}": train(scene), f"gsplat-{scene.name}": gsplat(scene)}
    return parts


def write(path: Path, results: dict[str, Any]) -> None:
    """Replace the file in one step."""
    temporary = path.with_name(f"{path.name}.part")
    temporary.write_text(json.dumps(results, indent=2) + "\n")
    temporary.replace(path)


def measure(path: Path, setting: Setting, parts: dict[str, Callable[[Setting], Any]], again: Sequence[str]) -> int:
    """Make the parts that the file does not have, and those that are to be made again; 1 if one failed."""
    results: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    setting.environment.update(results.get("find", {}).get("result", {}).get("environment", {}))
    failed = False
    for name, part in parts.items():
        if name not in again and (again or "result" in results.get(name, {})):
            continue
        start = time.monotonic()
        try:
            entry: dict[str, Any] = {"result": part(setting)}
        except (OSError, RuntimeError, TimeoutError, ValueError, subprocess.SubprocessError) as error:
            entry, failed = {"trouble": str(error)}, True
        results[name] = entry | {"seconds": time.monotonic() - start, "date": time.strftime("%Y-%m-%d")}
        write(path, results)
        print(
            f"{name}: {results[name]['seconds']:.0f} s{': ' + entry['trouble'] if 'trouble' in entry else ''}",
            flush=True,
        )
    return int(failed)


def starter(version: str) -> str:
    """The script of an archive, for this version of Python: from any folder, with the archive's scenes if no others
    are asked for."""
    return f"""#!/bin/sh
here=$(cd "$(dirname "$0")" && pwd) || exit 2
scenes=$(find "$here/scenes" -mindepth 1 -maxdepth 1 -type d 2> /dev/null | sort | paste -s -d , -)
PYTHONPATH=$here/packages:$here exec python{version} "$here/tools/measure_gpu.py" --scenes "$scenes" "$@"
"""


def pack(archive: Path, scenes: Sequence[Path]) -> int:
    """Write the archive; 1 if it is larger than PACK_LIMIT."""
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder) / "clsplat"
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for name in filter(None, listed.split("\0")):
            if name.startswith(("clsplat/", "kernels/", "tools/", "pyproject.toml", "LICENSE")):
                (top / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, top / name)
        for package in _packages("clsplat"):
            _copy_package(package, top / "packages")
        for scene in scenes:
            shutil.copytree(scene, top / "scenes" / scene.name)
        shutil.copy2(ROOT / "tools" / "pinhole_pycolmap.py", top / "packages" / "pycolmap.py")
        libraries = (top / "packages").rglob("*.so*")
        # those that a wheel brings beside its modules have been moved about in: strip makes them unreadable
        stripped = [str(path) for path in libraries if not path.parent.name.endswith(".libs")]
        subprocess.run(["strip", "--strip-unneeded", *stripped], check=False, capture_output=True)
        check_imports(top)
        version = sysconfig.get_python_version()
        (top / "measure").write_text(starter(version))
        subprocess.run(["tar", "-cJf", str(archive.resolve()), "-C", folder, "clsplat"], check=True)
    size = archive.stat().st_size
    print(f"{archive}: {size / 1e6:.1f} MB, for Python {version} on {platform.machine()}")
    if size > PACK_LIMIT:
        print(f"measure_gpu: {archive} is larger than {PACK_LIMIT / 1e6:g} MB: name smaller scenes", file=sys.stderr)
        return 1
    return 0


def check_imports(top: Path) -> None:
    """Raise RuntimeError where what an archive holds cannot be imported without anything else."""
    words = f"import {', '.join(IMPORTS)}"
    alone = {**os.environ, "PYTHONPATH": f"{top / 'packages'}{os.pathsep}{top}"}
    done = subprocess.run(
        [sys.executable, "-S", "-c", words], env=alone, cwd=top, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise RuntimeError(f"the packages of the archive are not enough: {done.stderr.strip().splitlines()[-1]}")


def _packages(name: str) -> set[str]:
    """The packages that one needs, and those they need, as far as they are installed, without LEFT_OUT."""
    names: set[str] = set()
    waiting = [name]
    while waiting:
        current = waiting.pop()
        for text in metadata.requires(current) or ():
            requirement, _, marker = text.partition(";")
            needed = "".join(letter if letter.isalnum() or letter in "-_." else " " for letter in requirement).split()[
                0
            ]
            if "extra" in marker or needed.lower() in LEFT_OUT or needed in names:
                continue
            try:
                metadata.version(needed)
            except metadata.PackageNotFoundError:
                continue
            names.add(needed)
            waiting.append(needed)
    return names


def _copy_package(name: str, target: Path) -> None:
    for entry in metadata.files(name) or ():
        used = PARTS_USED.get(entry.parts[0]) if len(entry.parts) > 2 else None
        if (
            ".." in entry.parts
            or "tests" in entry.parts
            or entry.suffix == ".pyc"
            or (used and entry.parts[1] not in used)
        ):
            continue
        source = Path(str(entry.locate()))
        if source.is_file():
            (target / entry).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target / entry)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="the JSON file")
    parser.add_argument("--scenes", default="", help="folders of scenes, with commas between")
    parser.add_argument("--parts", default="", help="make these, again if they are there")
    parser.add_argument("--device", default="gpu")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds of a part")
    parser.add_argument("--pack", type=Path, metavar="ARCHIVE")
    options = parser.parse_args(words)
    scenes = [Path(name).resolve() for name in options.scenes.split(",") if name]
    for scene in scenes:
        if not scene.is_dir():
            parser.error(f"{scene}: no such folder, expected a scene")
    if options.pack is not None:
        try:
            return pack(options.pack, scenes)
        except RuntimeError as error:
            print(f"measure_gpu: {error}", file=sys.stderr)
            return 1
    if options.file is None:
        parser.error("the name of the JSON file is missing")
    if not options.file.parent.is_dir():
        parser.error(f"{options.file.parent}: no such folder, expected one for {options.file.name}")
    parts, again = parts_of(scenes), [name for name in options.parts.split(",") if name]
    if unknown := sorted(set(again) - set(parts)):
        parser.error(f"--parts: {', '.join(unknown)}: expected of {', '.join(parts)}")
    runs = options.file.resolve().with_suffix("")
    runs.mkdir(exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return measure(options.file, Setting(environment, runs, options.device, options.limit), parts, again)


if __name__ == "__main__":
    sys.exit(main())
