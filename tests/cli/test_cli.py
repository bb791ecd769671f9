# SPDX-License-Identifier: Apache-2.0
"""The command line as a user calls it. What computes is replaced by fakes here; the pipeline has its own tests."""

import errno
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, command, error_line, fails, printed, python, raising, ran, rejected
from fakes import Pipeline

from clsplat.cli.eval import EvalVerb
from clsplat.cli.main import main, parse
from clsplat.cli.session import Services
from clsplat.cli.train import TrainVerb
from clsplat.cli.training_run import TrainingMachine
from clsplat.config.cli_defaults import DEMO_ITERATIONS
from clsplat.config.training import TrainConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.runs.run import Run
from clsplat.scenes.dataset import SOURCE_FRAME
from clsplat.scenes.sfm.reconstruct import SfmSettings


@pytest.mark.smoke
@pytest.mark.parametrize("verb", ["devices", "demo", "sfm", "train", "eval", "render"])
def test_help(verb: str, capsys: Capture) -> None:
    assert f"usage: clsplat {verb}" in printed(capsys, [verb, "--help"]).out
    assert verb in printed(capsys, ["--help"]).out


def test_every_training_flag_has_help(capsys: Capture) -> None:
    main(["train", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for part in (
        "--dssim-weight FLOAT Weight w of D-SSIM",
        "--density.split-factor FLOAT Factor",
        "--eval-at STEP,STEP,",
    ):
        assert part in text


@pytest.mark.parametrize("verb", ["train", "convert", "render"])
def test_help_loads_nothing_heavy(verb: str) -> None:
    code = f"import sys, clsplat, clsplat.cli.main; clsplat.cli.main.main(['{verb}', '--help']); "
    code += "heavy = {'pyopencl', 'pycolmap', 'scipy', 'skimage', 'OpenImageIO'} & set(sys.modules); "
    code += "sys.exit(str(heavy) if heavy else 0)"
    done = python("-c", code, timeout=60)
    assert done.returncode == 0, done.stderr


def test_flags_become_the_config() -> None:
    line = "train S -o R --iterations 50 --eval-at 10,20,30 --warmup 5 --optimiser.beta1 0.8 --density.every 0"
    verb = parse([*line.split(), "--density.absolute-gradients", "--background", "random", "--device", "gpu"])
    assert isinstance(verb, TrainVerb)
    assert (verb.scene, verb.output, verb.device) == (Path("S"), Path("R"), TrainingMachine("gpu"))
    config = verb.config
    assert (config.iterations, config.eval_at, config.warmup) == (50, (10, 20, 30), (5,))
    assert (config.optimiser.beta1, config.density.every, config.density.absolute_gradients) == (0.8, 0, True)
    assert config.background == "random"
    assert config.seed == TrainConfig().seed
    assert parse(["train", "S", "--output", "R"]) == TrainVerb(Path("R"), Path("S"))
    assert parse(["train", "S", "-o", "R", "--warmup", ""]).config.warmup == ()  # type: ignore[union-attr]
    assert parse(["eval", "R"]) == EvalVerb(Path("R"))


def test_the_demo_takes_the_steps_it_is_given(tmp_path: Path) -> None:
    given = []

    def run_demo(output: Path, *, device: str | None, iterations: int) -> dict[str, object]:
        given.append((output, iterations))
        return {}

    services = Services(run_demo=run_demo)
    assert main(["demo", "-o", str(tmp_path), "--iterations", "30"], services) == 0
    assert main(["demo", "-o", str(tmp_path)], services) == 0
    assert given == [(tmp_path, 30), (tmp_path, DEMO_ITERATIONS)]


def test_a_demo_of_no_steps_is_refused_before_anything_is_made(tmp_path: Path, capsys: Capture) -> None:
    assert main(["demo", "-o", str(tmp_path / "demo"), "--iterations", "0"]) == 2
    assert "--iterations 0: expected at least 1" in error_line(capsys)
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--sh-degree 4", "--sh-degree 4: expected 0 to 3"),
        ("--iterations 0", "--iterations 0: expected at least 1"),
        *((f"--eval-at {steps}", f"--eval-at {steps}: expected steps") for steps in ("20,10", "0", "-5", "5,5")),
        ("--dssim-weight 2", "--dssim-weight 2.0"),
        ("--test-every -1", "--test-every -1"),
    ],
)
def test_settings_without_sense(flags: str, message: str, folder: str, tmp_path: Path, capsys: Capture) -> None:
    assert message in rejected(capsys, ["train", folder, "-o", tmp_path / "run", *flags.split()])
    assert not (tmp_path / "run").exists()


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("error", "status"),
    [
        (ClsplatError("work\nfailed"), 1),
        (InputError("input is wrong"), 2),
        (OSError(errno.ENOSPC, "No space left on device", "/full/model.ply"), 1),
    ],
)
def test_exit_status(error: Exception, status: int, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr("clsplat.cli.devices.run", raising(error))
    monkeypatch.delenv("CLSPLAT_DEBUG", raising=False)
    line = rejected(capsys, ["devices"], status=status)
    assert (" ".join(str(error).split()) if isinstance(error, ClsplatError) else "model.ply: the disk is full") in line
    monkeypatch.setenv("CLSPLAT_DEBUG", "1")
    assert "Traceback" in printed(capsys, ["devices"], status=status).err


def test_warnings_are_lines(model: str, folder: str, pipeline: Pipeline, capsys: Capture) -> None:
    with open(model, "ab") as file:
        file.write(b"more")
    said = ran(capsys, pipeline.main, ["eval", model, "--scene", folder]).err
    assert f"clsplat: warning: {model}: 4 bytes after the last Gaussian are ignored\n" in said


def test_sfm(folder: str, tmp_path: Path, capsys: Capture) -> None:
    calls = []

    def reconstruct(
        photos: Path, output: Path, settings: SfmSettings, *, progress: Callable[..., None], **options: object
    ) -> Path:
        progress("matching photos", 0.5)
        calls.append((str(photos), settings, options))
        output.mkdir()
        (output / "sfm.json").write_text('{"photos": 3}')
        return output

    services = Services(reconstruct=reconstruct)
    assert (
        main(
            ["sfm", folder, "-o", str(tmp_path / "out"), "--matching", "sequential", "--mapper", "global", "--json"],
            services,
        )
        == 0
    )
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"photos": 3, "frame": SOURCE_FRAME.document()}
    assert captured.err.splitlines()[0] == "matching photos 50 %"
    options = {"threads": None, "overwrite": False, "masks": None, "frames": None}
    assert calls == [(folder, SfmSettings("sequential", "auto", mapper="global"), options)]
    assert "none: no such file or folder" in rejected(capsys, ["sfm", tmp_path / "none", "-o", tmp_path / "out"])


def test_train(folder: str, tmp_path: Path, pipeline: Pipeline, capsys: Capture) -> None:
    run = tmp_path / "runs" / "a"
    captured = printed(capsys, ["train", folder, "-o", run, "--iterations", "9", "--json"], call=pipeline.main)
    assert json.loads(captured.out)["mean"]["psnr"] == 20
    assert "clsplat: warning: one photo is dark" in captured.err
    assert "step 1/9  loss 0.1000" in captured.err
    assert pipeline.calls == [("load_scene", folder, 0, 8), ("train", 9, 0, False)]
    assert Run.open(run).scene == Path(folder)


def test_an_output_that_is_a_run(folder: str, tmp_path: Path, pipeline: Pipeline, capsys: Capture) -> None:
    run = tmp_path / "run"
    assert pipeline.main(["train", folder, "-o", str(run), "--iterations", "9", "--seed", "3"]) == 0
    before = (run / "model.ply").read_bytes()
    capsys.readouterr()
    pipeline.calls.clear()
    assert "already a run, use --resume" in rejected(capsys, ["train", folder, "-o", run], call=pipeline.main)
    assert pipeline.main(["train", folder, "-o", str(run), "--resume", "--overwrite"]) == 2
    assert "exclude each other" in error_line(capsys)
    assert "no run to resume" in rejected(capsys, ["train", folder, "-o", folder, "--resume"], call=pipeline.main)
    for wrong in (["/no/such/scene"], [folder, "--device", "nosuch"], []):
        assert "expected" in rejected(capsys, ["train", *wrong, "-o", run, "--overwrite"], call=pipeline.main) or wrong
    assert (run / "model.ply").read_bytes() == before
    assert not any(call[0] == "train" for call in pipeline.calls)

    assert pipeline.main(["train", folder, "-o", str(run), "--overwrite", "--iterations", "5"]) == 0
    assert pipeline.calls[-1] == ("train", 5, 0, False)


def test_resume_takes_the_runs_settings(folder: str, tmp_path: Path, pipeline: Pipeline, capsys: Capture) -> None:
    run = str(tmp_path / "run")
    flags = ["--iterations", "9", "--seed", "3", "--density.absolute-gradients", "--warmup", "2,4"]
    assert pipeline.main(["train", folder, "-o", run, *flags]) == 0
    assert pipeline.main(["train", "--resume", "-o", run, "--iterations", "20"]) == 0
    assert pipeline.calls[-2:] == [("load_scene", folder, 0, 8), ("train", 20, 3, True)]
    assert (
        pipeline.main(["train", folder, "-o", run, *flags, "--resume"]) == 0
    )  # the first call again, with one flag more
    assert pipeline.calls[-1] == ("train", 9, 3, True)
    config = Run.open(run).config
    assert config.density.absolute_gradients
    assert config.warmup == (2, 4)
    capsys.readouterr()
    assert "seed is 3, a resumed run" in fails(capsys, pipeline.main, ["train", "--resume", "-o", run, "--seed", "4"])


def test_ctrl_c_leaves_a_resumable_run(folder: str, tmp_path: Path, pipeline: Pipeline, capsys: Capture) -> None:
    def interrupt(run: Run, on_step: object) -> None:
        run.save_checkpoint(4, {}, {})
        raise KeyboardInterrupt

    pipeline.training = interrupt
    run = str(tmp_path / "run")
    last = printed(capsys, ["train", folder, "-o", run], status=130, call=pipeline.main).err.splitlines()[-1]
    assert last == f"clsplat: interrupted at step 4; go on with: clsplat train -o {run} --resume"
    pipeline.training = lambda *_: None
    assert pipeline.main(["train", "-o", run, "--resume"]) == 0


def test_eval_of_a_run(folder: str, tmp_path: Path, pipeline: Pipeline, capsys: Capture) -> None:
    run = tmp_path / "run"
    assert pipeline.main(["train", folder, "-o", str(run), "--background", "white", "--iterations", "9"]) == 0
    (run / "eval.json").unlink()
    capsys.readouterr()
    result = json.loads(printed(capsys, ["eval", run, "--json"], call=pipeline.main).out)
    assert result == json.loads((run / "eval.json").read_text())
    assert (result["step"], result["gaussians"], result["seconds"]) == (9, 4, 2.5)
    assert [view["name"] for view in result["views"]] == ["0.jpg"]
    assert result["mean"]["psnr"] == pytest.approx(-20 * np.log10(0.25))
    assert pipeline.calls[-1] == ("render", 4, 32, 24, (1, 1, 1))
    assert [path.name for path in (run / "test").iterdir()] == ["0.png"]

    assert pipeline.main(["eval", str(run / "model.ply"), "--background", "black", "--resolution", "99"]) == 0
    looked = ("render", 4, 8, 6, (0, 0, 0))  # small, to warn of views that do not see the model
    assert pipeline.calls[-3:] == [("load_scene", folder, 99, 8), looked, ("render", 4, 32, 24, (0, 0, 0))]
    assert "1 held-out views  PSNR 12.04 dB" in capsys.readouterr().out


def test_eval_that_cannot_be(folder: str, model: str, pipeline: Pipeline, tmp_path: Path, capsys: Capture) -> None:
    cases = [
        ([model], "expected --scene SCENE"),
        ([model, "--scene", folder, "--test-every", "0"], "no view is held out"),
        ([str(tmp_path / "none.ply"), "--scene", folder], "no such file"),
        ([folder], "not a run"),
    ]
    for arguments, message in cases:
        assert message in printed(capsys, ["eval", *arguments], status=2, call=pipeline.main).err.splitlines()[-1]
    Run.create(tmp_path / "new", TrainConfig(), scene=folder)
    assert "has not written its model yet" in rejected(capsys, ["eval", tmp_path / "new"], call=pipeline.main)


@pytest.mark.smoke
def test_devices_for_real() -> None:
    listed = command("devices", "--json")
    assert listed.returncode == 0, listed.stderr
    devices = json.loads(listed.stdout)
    assert devices
    assert {"index", "name", "platform", "version", "kind"} <= devices[0].keys()
    assert devices[0]["name"] in command("devices").stdout


def test_reader_that_goes_away() -> None:
    command = [sys.executable, "-m", "clsplat", "train", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(timeout=60) == 1
