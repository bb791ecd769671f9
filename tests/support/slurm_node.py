# SPDX-License-Identifier: Apache-2.0
"""Slurm on this machine: one node with two task slots, with daemons that end with the test. Needs root or a user of
its own, and Debian's packages slurm-wlm and munge."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SLURM_PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "sinfo")
SLOTS = 2
"""Number of jobs that the node runs at once."""
START_SECONDS = 60
"""Seconds that the node has to become ready."""
SYSTEM_PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])


def slurm_is_there() -> bool:
    """True if all programs of Slurm and Munge are installed."""
    return all(shutil.which(name, path=SYSTEM_PATH) for name in SLURM_PROGRAMS)


def free_port() -> int:
    """A port that no process listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def configuration(folder: Path, user: str) -> str:
    """The text of slurm.conf. folder: folder of all files of the daemons. user: the user that runs them."""
    host = socket.gethostname().partition(".")[0]
    return f"""
ClusterName=clsplat
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
ReturnToService=2
SchedulerParameters=sched_interval=1,batch_sched_delay=0
NodeName={host} NodeAddr=127.0.0.1 CPUs={SLOTS} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES State=UP
"""


@contextmanager
def slurm_node(folder: Path) -> Iterator[dict[str, str]]:
    """Context manager that starts the daemons, and yields the environment for Slurm's commands.

    folder: an empty folder for all files, with a short path, as paths of sockets have at most 107 bytes.
    """
    import pwd

    user = pwd.getpwuid(os.getuid()).pw_name
    for name in ("state", "spool"):
        (folder / name).mkdir()
    folder.chmod(0o755)
    key = folder / "munge.key"
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o600)
    (folder / "slurm.conf").write_text(configuration(folder, user))
    environment = {**os.environ, "PATH": SYSTEM_PATH, "SLURM_CONF": str(folder / "slurm.conf")}
    munge = ["munged", "--foreground", "--force", "--key-file", str(key), "--socket", str(folder / "munge.socket")]
    munge += [word for name in ("pid", "log", "seed") for word in (f"--{name}-file", str(folder / f"munge.{name}"))]
    daemons: list[subprocess.Popen[bytes]] = []
    try:
        for words in (munge, ["slurmctld", "-D"], ["slurmd", "-D"]):
            with (folder / f"{words[0]}.txt").open("ab") as log:
                daemons.append(
                    subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
                )
            until = time.monotonic() + 10
            while words is munge and not (folder / "munge.socket").exists() and time.monotonic() < until:
                time.sleep(0.05)
        wait_for_node(folder, environment)
        yield environment
    finally:
        for daemon in reversed(daemons):
            with suppress(OSError):
                daemon.send_signal(signal.SIGTERM)
            try:
                daemon.wait(10)
            except subprocess.TimeoutExpired:
                daemon.kill()
                daemon.wait()


def wait_for_node(folder: Path, environment: dict[str, str]) -> None:
    """Wait until the node is idle. Raises AssertionError with the ends of the logs."""
    until = time.monotonic() + START_SECONDS
    while time.monotonic() < until:
        done = subprocess.run(["sinfo", "-h", "-o", "%T"], env=environment, capture_output=True, text=True, check=False)
        if done.stdout.strip() == "idle":
            return
        time.sleep(0.2)
    raise AssertionError("\n".join(path.read_text()[-1000:] for path in [*folder.glob("*.log"), *folder.glob("*.txt")]))


def wait_for_jobs(environment: dict[str, str], seconds: float) -> bool:
    """Wait until Slurm has no jobs. Returns False after `seconds`."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        words = ["squeue", "-h", "-o", "%i"]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
        if not done.stdout.split():
            return True
        time.sleep(0.2)
    return False
