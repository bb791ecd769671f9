#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Runs the lines of Docker files in fresh Debian roots, where there is no Docker: as root, with debootstrap and chroot.

    sudo tools/ci/docker_lines.py packaging/docker/*.Dockerfile

Each file starts from its own copy of the Debian that its line FROM names. RUN, COPY, ENV and WORKDIR do what they do in
Docker, then the command of ENTRYPOINT and CMD runs once. The wheel has to be in dist/ (`tools/release --build`).
Roots and copies are in the folder --roots. The next run uses the same roots, and new copies.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MIRROR = "http://deb.debian.org/debian"
IMAGE = re.compile(r"debian:(\w+)(-slim)?")
PATHS = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
"""PATH in an image until a line ENV changes it."""
OF_HOST = ("etc/resolv.conf", "etc/hosts")
"""Files that a root gets from this machine, so that it reaches package indexes as this machine does."""
CERTIFICATES = "host-certificates.crt"
"""Name in a root of the file that PIP_CERT names on this machine; Debian's own certificates stay as they are."""
KNOWN = {"FROM", "RUN", "COPY", "ENV", "WORKDIR", "ENTRYPOINT", "CMD"}
IN_ROOT = """for folder in proc sys dev; do mount --rbind /$folder "$0/$folder" || exit; done
exec chroot "$0" /bin/sh -c "$1\""""
"""Shell commands that run a command in a root, with this machine's /proc, /sys and /dev mounted while it runs."""


@dataclass(frozen=True)
class Line:
    """An instruction of a Docker file, with its continuation lines joined. number: that of its first line, from 1."""

    number: int
    keyword: str
    text: str


@dataclass
class Image:
    """The state of an image while its lines run."""

    folder: Path
    variables: dict[str, str] = field(default_factory=lambda: {"PATH": PATHS, "HOME": "/root"})
    working: str = "/"
    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)


def lines_of(text: str) -> Iterator[Line]:
    """The instructions of a Docker file, without comments."""
    begun = 0
    parts: list[str] = []
    for number, row in enumerate(text.splitlines(), 1):
        if row.lstrip().startswith("#") or not row.strip():
            continue
        begun = begun if parts else number
        parts.append(row.rstrip().removesuffix("\\").strip())
        if row.rstrip().endswith("\\"):
            continue
        keyword, _, rest = " ".join(parts).partition(" ")
        yield Line(begun, keyword.upper(), rest.strip())
        parts = []


def base_of(path: Path) -> str:
    """Return the Debian release that the line FROM names.

    Raises ValueError for an instruction that this tool does not run, and if the first line is not FROM with Debian.
    """
    lines = list(lines_of(path.read_text("utf-8")))
    for line in lines:
        if line.keyword not in KNOWN:
            raise ValueError(f"{path}:{line.number}: {line.keyword}, expected one of {', '.join(sorted(KNOWN))}")
    found = IMAGE.fullmatch(lines[0].text) if lines and lines[0].keyword == "FROM" else None
    if found is None:
        raise ValueError(f"{path}: the first line is not FROM debian:RELEASE or debian:RELEASE-slim")
    return found[1]


def fresh_root(roots: Path, release: str) -> Path:
    """The folder of a minimal Debian, made by debootstrap if it is not there."""
    folder = roots / release
    if not (folder / "etc/debian_version").is_file():
        print(f"== debootstrap {release}", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        if (
            subprocess.run(["debootstrap", "--variant=minbase", release, str(folder), MIRROR], check=False).returncode
            != 0
        ):
            shutil.rmtree(folder, ignore_errors=True)
            sys.exit(f"debootstrap {release} failed, see above; is {MIRROR} reachable?")
    return folder


def run_file(path: Path, roots: Path, context: Path) -> None:
    """Run all lines of a Docker file in a copy of its base, then the image's command.

    Exits with a message at the first line that fails. context: folder that COPY reads from.
    """
    base = fresh_root(roots, base_of(path))
    image = Image(roots / path.stem)
    shutil.rmtree(image.folder, ignore_errors=True)
    subprocess.run(["cp", "--archive", "--reflink=auto", str(base), str(image.folder)], check=True)
    for name in OF_HOST:
        if Path("/", name).is_file():
            (image.folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(Path("/", name), image.folder / name)
    if os.environ.get("PIP_CERT"):
        shutil.copyfile(os.environ["PIP_CERT"], image.folder / CERTIFICATES)
    for line in lines_of(path.read_text("utf-8")):
        begun = time.monotonic()
        if not _step(image, line, context):
            sys.exit(f"{path}:{line.number}: {line.keyword} {line.text} failed, see above")
        print(
            f"== {path.name}:{line.number} {line.keyword} {line.text[:70]}: {time.monotonic() - begun:.0f} s",
            flush=True,
        )
    words = image.entrypoint + image.command
    if not words or not _run(image, shlex.join(words)):
        sys.exit(f"{path}: the image's command failed: {shlex.join(words) or 'neither ENTRYPOINT nor CMD'}")


def _step(image: Image, line: Line, context: Path) -> bool:
    """Do what an instruction says. Returns False if it failed."""
    if line.keyword == "RUN":
        return _run(image, line.text)
    if line.keyword == "COPY":
        *sources, target = line.text.split()
        found = [path for source in sources for path in sorted(context.glob(source))]
        for path in found:
            place = image.folder / target.strip("/")
            shutil.copy(path, place / path.name if target.endswith("/") else place)
        if not found:
            print(f"{context}: no file {' '.join(sources)}; tools/release --build makes dist/", file=sys.stderr)
        return bool(found)
    if line.keyword == "ENV":
        for word in shlex.split(line.text):
            name, _, value = word.partition("=")
            image.variables[name] = re.sub(r"\$(\w+)", lambda found: image.variables.get(found[1], ""), value)
    elif line.keyword == "WORKDIR":
        image.working = line.text
        (image.folder / line.text.strip("/")).mkdir(parents=True, exist_ok=True)
    elif line.keyword == "ENTRYPOINT":
        image.entrypoint = json.loads(line.text)
    elif line.keyword == "CMD":
        image.command = json.loads(line.text)
    return True


def _run(image: Image, command: str) -> bool:
    """Run a shell command in the image. Returns False if it failed.

    This machine's variables for pip are passed, so that pip uses the same package index in the image.
    """
    pip = {name: value for name, value in os.environ.items() if name.startswith("PIP_") and name != "PIP_FIND_LINKS"}
    if "PIP_CERT" in pip:
        pip["PIP_CERT"] = f"/{CERTIFICATES}"
    variables = {"DEBIAN_FRONTEND": "noninteractive", **pip, **image.variables}
    inside = f"cd {shlex.quote(image.working)} && {command}"
    words = ["unshare", "--mount", "/bin/sh", "-c", IN_ROOT, str(image.folder), inside]
    return subprocess.run(words, env=variables, stdin=subprocess.DEVNULL, check=False).returncode == 0


def main(arguments: list[str]) -> int:
    """Run every file that is named."""
    parser = argparse.ArgumentParser(description="Run Docker files' lines in fresh Debian roots.", allow_abbrev=False)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument(
        "--roots", type=Path, default=ROOT / "build/roots", help="folder of the roots (default: build/roots)"
    )
    parser.add_argument(
        "--context", type=Path, default=ROOT, help="folder that COPY reads from (default: the checkout)"
    )
    asked = parser.parse_args(arguments)
    for path in asked.files:
        if not path.is_file():
            parser.error(f"{path}: no such file, expected a Docker file such as packaging/docker/cpu.Dockerfile")
        try:
            base_of(path)
        except ValueError as error:
            parser.error(str(error))
    if sys.platform != "linux" or os.geteuid() != 0 or not shutil.which("debootstrap"):
        sys.exit("docker_lines.py: expected root on Linux, with debootstrap (apt install debootstrap)")
    asked.roots.mkdir(parents=True, exist_ok=True)
    for path in asked.files:
        run_file(path, asked.roots.resolve(), asked.context.resolve())
    print(f"passed: {', '.join(path.name for path in asked.files)}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
