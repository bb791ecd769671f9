# SPDX-License-Identifier: Apache-2.0
"""Compile kernels for GPUs without having them, with clang and NVIDIA's assembler, and parse the output."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from gpu_assembly import Loop, parse_gcn, parse_sass

from clsplat.device.program import text_of
from clsplat.errors import ClsplatError
from clsplat.files.user_cache import cache_folder

CLANG = "19"
"""Version of clang, on which the counts depend. 16 is the first that supports every target."""
NVIDIA = "13.5.37"
"""Version of the packages with NVIDIA's assembler and disassembler."""
PACKAGES = {"ptxas": "nvidia-cuda-nvcc", "nvdisasm": "nvidia-cuda-nvdisasm"}
TARGETS = ("sm_75", "sm_89", "sm_90", "gfx90a", "gfx1030", "gfx1100")
BUILTINS = Path(__file__).with_name("gpu_builtins.cl")
FLAGS = ("-x", "cl", "-O3", "-nogpulib", "-Xclang", "-finclude-default-header", "-Wno-everything")


class NoCompilerError(ClsplatError):
    """A compiler is missing; the message says what to install."""

    exit_status = 2


@dataclass(frozen=True)
class Built:
    """A kernel compiled for a target.

    registers: registers per work-item.
    spills, stack: bytes per work-item.
    shared: bytes per group.
    whole: the kernel as a loop that runs once.
    """

    kernel: str
    target: str
    registers: int
    spills: int
    stack: int
    shared: int
    whole: Loop


TEXTS: dict[tuple[str, str], str] = {}
"""Texts of kernel files of older code, by commit and stem (`gpu_recount.py`)."""


@dataclass(frozen=True)
class Source:
    """A kernel file and the options with which clsplat builds it. commit: of older code, whose text is in TEXTS."""

    stem: str
    options: tuple[str, ...]
    commit: str = ""

    @classmethod
    def of(cls, launch: Mapping[str, Any]) -> Source:
        """The source of a launch's kernel."""
        return cls(launch["stem"], tuple(launch["options"]), launch.get("commit", ""))

    @property
    def text(self) -> str:
        """The whole text, with all headers."""
        return TEXTS[self.commit, self.stem] if self.commit else text_of(self.stem)

    @property
    def items(self) -> int:
        """Number of work-items in a group, for kernels whose items cooperate."""
        return next(int(each.partition("=")[2]) for each in self.options if each.startswith("-DITEMS="))

    @property
    def by_gaussian(self) -> bool:
        """True for the gradient of blending in which each item has a Gaussian."""
        return "-DBY_GAUSSIAN" in self.options

    @property
    def subgroup(self) -> int:
        """Number of items that exchange values, 1 if none do."""
        return next((int(each.partition("=")[2]) for each in self.options if each.startswith("-DSUBGROUP=")), 1)

    @property
    def common(self) -> tuple[str, ...]:
        """The options that every driver takes, without those of NVIDIA's."""
        return tuple(each for each in self.options if not each.startswith("-cl-nv-"))

    @property
    def register_limit(self) -> tuple[str, ...]:
        """The option of ptxas for the limit of registers, if there is one."""
        return tuple(each.replace("-cl-nv-", "-") for each in self.options if each.startswith("-cl-nv-maxrregcount="))

    def options_for(self, target: str) -> tuple[str, ...]:
        """Clang's options, including the target's functions for exchanging values."""
        shuffle = "-DSHUFFLE_PTX" if target.startswith("sm_") else "-DSHUFFLE_AMD"
        return tuple(shuffle if each.startswith("-DSHUFFLE") else each for each in self.common)

    @property
    def shape(self) -> str:
        """The kernels' shape, as in CLSPLAT_SHAPE."""
        return f"1x{self.items}{'g' if self.by_gaussian else 's' if self.subgroup > 1 else ''}"

    @property
    def label(self) -> str:
        """The file's stem, with the defines other than the shape."""
        shape = ("-DITEMS=", "-DLANES=", "-DSUBGROUP=", "-DSHUFFLE", "-cl")
        defines = [each[2:].removesuffix("=1") for each in self.options if not each.startswith(shape)]
        return " ".join((self.stem, *defines))

    @property
    def used(self) -> Source:
        """The source without defines that its text does not use. Two sources with equal `used` have the same kernels,
        such as those of most files in shapes that differ only in the number of items."""
        words = set(re.findall(r"\w+", self.text))
        names = {each: each.removeprefix("-D").partition("=")[0].partition("(")[0] for each in self.options}
        kept = (each for each in self.options if not each.startswith("-D") or names[each] in words)
        return Source(self.stem, tuple(kept), self.commit)

    @property
    def lines(self) -> list[str]:
        """The text's lines."""
        return self.text.splitlines()


def clang() -> str:
    """Path of clang. Raises NoCompilerError."""
    found = shutil.which(f"clang-{CLANG}") or shutil.which("clang") or ""
    version = _run([found, "--version"]).stdout if found else ""
    if re.search(rf"clang version {CLANG}\.", version) is None:
        instead = f"; {found} is another version" if found else ""
        raise NoCompilerError(f"no clang {CLANG} found{instead}: apt install clang-{CLANG}")
    return found


def compilers() -> str:
    """The versions of clang and ptxas, as text."""
    version = re.search(r"clang version (\S+)", _run([clang(), "--version"]).stdout)
    return f"clang {version[1] if version else CLANG}, ptxas {NVIDIA}"


@cache
def nvidia(name: str) -> str:
    """The path of ptxas or nvdisasm, in the cache folder. pip downloads it if it is missing. Raises NoCompilerError."""
    path = cache_folder() / f"nvidia-{NVIDIA}" / name
    if path.is_file():
        return str(path)
    package = f"{PACKAGES[name]}=={NVIDIA}"
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        pip = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--only-binary", ":all:", "-d", scratch]
        done = _run([*pip, package])
        wheels = list(Path(scratch).glob("*.whl"))
        if done.returncode or not wheels:
            last = (done.stderr.strip() or "nothing was downloaded").splitlines()[-1]
            raise NoCompilerError(f"no {name} found: {path} is not there, and pip download {package} failed: {last}")
        with zipfile.ZipFile(wheels[0]) as wheel:
            member = next(each for each in wheel.namelist() if each.endswith(f"bin/{name}"))
            fresh = Path(wheel.extract(member, scratch))
        fresh.chmod(0o755)
        fresh.replace(path)
    return str(path)


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)


def run_checked(command: Sequence[str], what: str) -> str:
    """Run a command, and return its output and errors. Raises ClsplatError if it fails. what: begins the message."""
    done = _run(command)
    if done.returncode:
        told = [line for line in done.stderr.splitlines() if "error" in line or "fatal" in line]
        raise ClsplatError(f"{what}: {(told or done.stderr.splitlines() or [f'status {done.returncode}'])[0]}")
    return done.stdout + done.stderr


def target_flags(target: str) -> tuple[str, ...]:
    """Clang's options for a target."""
    if target.startswith("sm_"):
        return ("--target=nvptx64-nvidia-cuda", f"-march={target}")
    return ("--target=amdgcn-amd-amdhsa", f"-mcpu={target}")


def build_builtins(target: str, folder: Path) -> Path:
    """Compile the built-in functions to bitcode in the folder. It has no source lines, so that their instructions count
    for the line of the caller."""
    path = folder / f"builtins-{target}.bc"
    options = (*FLAGS, *target_flags(target), "-cl-std=CL1.2", "-cl-fp32-correctly-rounded-divide-sqrt")
    run_checked([clang(), *options, "-c", "-emit-llvm", str(BUILTINS), "-o", str(path)], BUILTINS.name)
    return path


def assembled(source: Source, target: str, builtins: Path, folder: Path) -> Path:
    """Compile a kernel file to assembly in the folder. Raises ClsplatError if clang refuses it.

    builtins: from `build_builtins`.
    """
    what = f"{source.label} for {target}"
    text, assembly = (folder / f"{source.stem}.{end}" for end in ("cl", "s"))
    text.write_text(source.text, encoding="utf-8")
    link = ("-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(builtins))
    options = (*FLAGS, "-gline-tables-only", *target_flags(target), *source.options_for(target), *link)
    run_checked([clang(), *options, "-S", str(text), "-o", str(assembly)], what)
    if missing := re.search(r"\b_Z(\d+)(\w+)", assembly.read_text()):
        name = missing[2][: int(missing[1])]
        raise ClsplatError(f"{what}: {BUILTINS.name} has no body of the built-in function {name}")
    return assembly


def compile_source(source: Source, target: str, builtins: Path) -> list[Built]:
    """Compile a kernel file. Raises ClsplatError if a compiler refuses it. builtins: from `build_builtins`."""
    with tempfile.TemporaryDirectory(dir=builtins.parent) as scratch:
        assembly = assembled(source, target, builtins, Path(scratch))
        if not target.startswith("sm_"):
            return read_amd(assembly.read_text(), target)
        cubin = Path(scratch) / f"{source.stem}.cubin"
        ptxas = (nvidia("ptxas"), "-v", "-lineinfo", f"-arch={target}", *source.register_limit)
        told = run_checked([*ptxas, str(assembly), "-o", str(cubin)], f"{source.label} for {target}")
        disassembly = run_checked([nvidia("nvdisasm"), "-c", "-g", "-hex", str(cubin)], f"{source.label} for {target}")
        return read_nvidia(told, disassembly, target)


_FUNCTION = re.compile(
    r"Compiling entry function '(?P<name>\w+)'.*?"
    r"(?P<stack>\d+) bytes stack frame, (?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?"
    r"Used (?P<registers>\d+) registers(?P<rest>[^\n]*)",
    re.DOTALL,
)


def read_nvidia(told: str, sass: str, target: str) -> list[Built]:
    """Kernels, from the outputs of `ptxas -v` and `nvdisasm -c`."""
    wholes = parse_sass(sass)
    built = []
    for match in _FUNCTION.finditer(told):
        shared = re.search(r"(\d+) bytes smem", match["rest"])
        spills = int(match["stores"]) + int(match["loads"])
        numbers = (int(match["registers"]), spills, int(match["stack"]), int(shared[1]) if shared else 0)
        built.append(Built(match["name"], target, *numbers, wholes[match["name"]]))
    return built


def read_amd(assembly: str, target: str) -> list[Built]:
    """Kernels, from the metadata in clang's assembly."""
    wholes = parse_gcn(assembly)
    entries = assembly.partition("amdhsa.kernels:")[2].partition("amdhsa.target:")[0]
    built = []
    for entry in re.split(r"^  - ", entries, flags=re.MULTILINE)[1:]:
        numbers = {key: int(value) for key, value in re.findall(r"^ +\.(\w+): +(\d+)$", entry, re.MULTILINE)}
        name = re.search(r"^    \.name: +(\w+)$", entry, re.MULTILINE)
        assert name is not None, "every kernel has one"
        spills = 4 * (numbers.get("vgpr_spill_count", 0) + numbers.get("sgpr_spill_count", 0))
        registers = numbers["vgpr_count"] + numbers.get("agpr_count", 0)
        stack, shared = numbers["private_segment_fixed_size"], numbers["group_segment_fixed_size"]
        built.append(Built(name[1], target, registers, spills, stack, shared, wholes[name[1]]))
    return built


def ask_package(shape: str, frames: Sequence[Mapping[str, Any]], folder: Path = Path(__file__).parent) -> list[Any]:
    """Launches of each frame, as `gpu_variants.py` records them. Raises ClsplatError.

    shape: a shape, or "variant N" for a variant of a trial.
    folder: the folder of this script, of the present code or of a copy of older code.
    """
    script = folder / "gpu_variants.py"
    command = [sys.executable, str(script), shape, *(json.dumps(frame) for frame in frames)]
    root = str(script.parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise ClsplatError(f"{script.name} {shape}: ended with status {done.returncode}: {last}")
    answer: list[Any] = json.loads(done.stdout.splitlines()[-1])
    return answer
