# SPDX-License-Identifier: Apache-2.0
"""Training settings that are recommended because of the findings about a scene, and applied with --auto."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

from clsplat.config.presets import by_passes, scheduled
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.scenes.analysis.photo_findings import Finding, Kind

SCHEDULE_SETTING = "schedule"
"""Key in a dictionary of recommended settings. Its value names a schedule: a bundle of learning rates and steps."""
SETTINGS_BY_FINDING: Mapping[Kind, Sequence[Mapping[str, Any]]] = {
    "exposure": ({"appearance": "exposure"},),
    "scales": ({"antialiased": True},),
    "masks": ({"masks": "ignore"},),
    "cut out": ({"masks": "transparent"}, {"masks": "ignore"}),
    "alpha": ({"alpha": "transparent"}, {"alpha": "ignore"}),
    "undistorted": ({"lenses": "native"},),
    "few steps": ({SCHEDULE_SETTING: "high-rates"},),
    "few views": (
        {
            "thinning": 0.2,
            "penalty": 0.02,
            SCHEDULE_SETTING: "high-rates",
            "iterations": 2000,
            "optimiser.sh_rest_rate": 4e-4,  # few photographs hardly constrain view-dependent colour
        },
        {"thinning": 0.2, "penalty": 0.02},
        {"thinning": 0.2},
    ),
}
"""Alternative settings for each kind of finding, best first. The first one compatible with the other settings is used.
"""
PASSES_SETTING = "passes"
"""Key in a dictionary of recommended settings. Its value is the number of passes through the photographs that the
schedule makes after scaling by `config.presets.by_passes`."""
SCHEDULED_SETTINGS = ("sh_degree_every", "optimiser", "density.stop", "density.noise_rate")
"""Settings that a schedule changes, apart from the number of steps."""
ADVICE_BY_FINDING: Mapping[Kind, str] = {
    "sky": "--sky 1000 adds distant initial points for the sky",
    "strange masks": "rename or remove files that are not masks",
    "blur": "leave them out if other photographs show the same",
    "duplicates": "remove the copies",
}
"""Advice for the kinds of findings that are not in SETTINGS_BY_FINDING."""


@dataclass(frozen=True)
class Answer:
    """A finding and the settings recommended for it.

    settings: the recommended settings. Empty if nothing is known to help, or if every option is incompatible with the
        other settings or would change a setting that the user has chosen.
    given: name of the setting that the best option would change, if every option would change a setting that the user
        has chosen; else "".
    """

    finding: Finding
    settings: Mapping[str, Any]
    given: str = ""

    @property
    def words(self) -> str:
        """Text of the finding and its settings, such as "12 of 20 photographs have masks (--masks ignore)".

        If there is advice that --auto cannot apply, it follows after a colon.
        """
        kind = self.finding.kind
        if advice := ADVICE_BY_FINDING.get(kind):
            return f"{self.finding.text}: {advice}"
        answer = flags(self.settings)
        if (options := _options(self.finding)) and not self.settings:
            wanted = flags(options[0])
            given = f"you set --{self.given.replace('_', '-')}"
            answer = given if self.given else f"{wanted} is incompatible with the other settings"
        return f"{self.finding.text} ({answer})" if answer else self.finding.text


def flags(settings: Mapping[str, Any]) -> str:
    """Return settings as command-line flags."""
    words = []
    for name, value in settings.items():
        text = ",".join(map(str, value)) if isinstance(value, tuple) else value
        words.append(f"--{name.replace('_', '-')}" + ("" if value is True else f" {text}"))
    return " ".join(words)


def answered(
    found: Sequence[Finding], config: TrainConfig, given: Collection[str] = (), photographs: int = 0
) -> tuple[list[Answer], TrainConfig]:
    """Choose settings for each finding. Returns the answers, in the same order, and `config` with all their settings.

    found: the findings.
    given: names of settings that the user has chosen, which must not change.
    photographs: number of training photographs, for settings that count passes through them.
    """
    answers = []
    for finding in found:
        options = _options(finding)
        touched = [_touched(option, given) for option in options]
        free = [option for option, name in zip(options, touched, strict=True) if not name]
        taken: Mapping[str, Any] = {}
        for option in free:
            try:
                config = with_settings(config, option, given, photographs)
            except InputError:
                continue
            taken = option
            break
        answers.append(Answer(finding, taken, "" if free or not options else touched[0]))
    return answers, config


def _options(finding: Finding) -> Sequence[Mapping[str, Any]]:
    """Return alternative settings for a finding, best first; empty if there are none."""
    return finding.options or SETTINGS_BY_FINDING.get(finding.kind, ())


def _touched(option: Mapping[str, Any], given: Collection[str]) -> str:
    """Return the name of the setting in `given` that `option` would change (the first by name); "" if there is none.

    option: recommended settings. A schedule among them changes further settings.
    given: names of settings that must not change.
    """
    names = {*option, *((*SCHEDULED_SETTINGS, "density.start") if SCHEDULE_SETTING in option else ())}
    names |= {"iterations"} if PASSES_SETTING in option else set()
    return min((name for name in given if name in names or name.partition(".")[0] in names), default="")


def with_settings(
    config: TrainConfig, settings: Mapping[str, Any], given: Collection[str] = (), photographs: int = 0
) -> TrainConfig:
    """Apply recommended settings to a configuration.

    given: names of settings that the user has chosen. A recommended number of passes does not change them.
    photographs: number of training photographs, for settings that count passes through them.
    Raises InputError if the settings are incompatible, or if a schedule would override values that the user has
    changed from the paper's.
    """
    changes = dict(settings)
    config = replace(config, iterations=changes.pop("iterations", config.iterations))
    if (name := changes.pop(SCHEDULE_SETTING, None)) is not None:
        paper, values = scheduled("paper", config.iterations), attrgetter(*SCHEDULED_SETTINGS)
        if values(config) != values(paper):
            raise InputError(
                f"--schedule {name}: would override {', '.join(SCHEDULED_SETTINGS)}, but some of them differ from "
                "the paper's; expected the paper's values, or no --schedule"
            )
        changes = dict(zip(SCHEDULED_SETTINGS, values(scheduled(name, config.iterations)), strict=True)) | changes
    if (passes := changes.pop(PASSES_SETTING, None)) is not None:
        config = by_passes(config, passes, photographs, given)
    for each, value in changes.items():
        config = config.changed(each, value)
    config.check()
    return config


def paragraph(answers: Sequence[Answer], photographs: int, *, auto: bool, sampled: int | None = None) -> str:
    """Return the report of the findings and of the recommended settings, in one line.

    photographs: number of photographs in the scene.
    auto: True if --auto was given, so that the settings are applied.
    sampled: number of photographs that were inspected, if not all.
    """
    inspected = f"{photographs:,}" if sampled in (None, photographs) else f"{sampled:,} of {photographs:,}"
    if not answers:
        return f"inspected {inspected} photographs: no setting needs to change"
    text = "; ".join(answer.words for answer in answers)
    settings = " ".join(filter(None, (flags(answer.settings) for answer in answers)))
    end = f". --auto {'takes' if auto else 'would take'} {settings}" if settings else ""
    return f"inspected {inspected} photographs: {text}{end}"
