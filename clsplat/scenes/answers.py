# SPDX-License-Identifier: Apache-2.0
"""Settings of training that answer findings about a scene."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

from clsplat.config.presets import scheduled
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.scenes.findings import Finding, Kind

SCHEDULE = "schedule"
"""Name of a bundle of settings among those of an answer."""
ANSWERS: Mapping[Kind, Sequence[Mapping[str, Any]]] = {
    "exposure": ({"appearance": "exposure"},),
    "scales": ({"antialiased": True},),
    "masks": ({"masks": "ignore"},),
    "cut out": ({"masks": "transparent"}, {"masks": "ignore"}),
    "alpha": ({"alpha": "transparent"}, {"alpha": "ignore"}),
    "fisheye": ({"lenses": "native"},),
    "few steps": ({SCHEDULE: "high-rates"},),
    "few views": (
        {
            "thinning": 0.2,
            "penalty": 0.02,
            SCHEDULE: "high-rates",
            "iterations": 2000,
            "optimiser.sh_rest_rate": 4e-4,  # colours by direction are what few photographs tell least of
        },
        {"thinning": 0.2, "penalty": 0.02},
        {"thinning": 0.2},
    ),
}
"""Settings by the finding that they answer, the best first: the first that goes with the other settings is taken."""
SCHEDULED = ("sh_degree_every", "optimiser", "density.stop", "density.noise_rate")
"""Settings that schedules have, beside the number of steps."""
ADVICE: Mapping[Kind, str] = {
    "sky": "--sky 1000 starts with points far away for it",
    "strange masks": "rename or remove what is no mask",
    "blur": "leave them out where others show the same",
    "duplicates": "remove the copies",
}
"""Advice on findings that no setting answers."""


@dataclass(frozen=True)
class Answer:
    """A finding and the settings that answer it; none where nothing does, or nothing that goes with the others. given:
    the name of a setting that is given in place of it."""

    finding: Finding
    settings: Mapping[str, Any]
    given: str = ""

    @property
    def words(self) -> str:
        """The finding with its answer, such as "exposures differ by 0.40 stops (--appearance exposure)"; advice that
        --auto does not take is behind a colon."""
        kind = self.finding.kind
        if advice := ADVICE.get(kind):
            return f"{self.finding.text}: {advice}"
        answer = flags(self.settings)
        if (options := _options(self.finding)) and not self.settings:
            wanted = flags(options[0])
            given = f"--{self.given.replace('_', '-')} is given"
            answer = given if self.given else f"{wanted} does not go with the other settings"
        return f"{self.finding.text} ({answer})" if answer else self.finding.text


def flags(settings: Mapping[str, Any]) -> str:
    """Settings as they are written on the command line."""
    words = []
    for name, value in settings.items():
        words.append(f"--{name.replace('_', '-')}" + ("" if value is True else f" {value}"))
    return " ".join(words)


def answered(
    found: Sequence[Finding], config: TrainConfig, given: Collection[str] = ()
) -> tuple[list[Answer], TrainConfig]:
    """The answers to findings, and the settings with all of them. given: names of settings that stay as they are."""
    answers = []
    for finding in found:
        options = _options(finding)
        touched = [_touched(option, given) for option in options]
        free = [option for option, name in zip(options, touched, strict=True) if not name]
        taken: Mapping[str, Any] = {}
        for option in free:
            try:
                config = with_settings(config, option)
            except InputError:
                continue
            taken = option
            break
        answers.append(Answer(finding, taken, "" if free or not options else touched[0]))
    return answers, config


def _options(finding: Finding) -> Sequence[Mapping[str, Any]]:
    """The settings that answer a finding, the best first; none where nothing does."""
    return finding.options or ANSWERS.get(finding.kind, ())


def _touched(option: Mapping[str, Any], given: Collection[str]) -> str:
    """The first given setting that an answer has too, or its schedule; "" if there is none."""
    names = {*option, *((*SCHEDULED, "density.start") if SCHEDULE in option else ())}
    return min((name for name in given if name in names or name.partition(".")[0] in names), default="")


def with_settings(config: TrainConfig, settings: Mapping[str, Any]) -> TrainConfig:
    """The settings with those of an answer. Raises InputError where they do not go together, and for a schedule where
    its settings are not the paper's."""
    changes = dict(settings)
    config = replace(config, iterations=changes.pop("iterations", config.iterations))
    if (name := changes.pop(SCHEDULE, None)) is not None:
        paper, values = scheduled("paper", config.iterations), attrgetter(*SCHEDULED)
        if values(config) != values(paper):
            raise InputError(f"--schedule {name}: the run has settings of its own in place of the paper's schedule")
        changes = dict(zip(SCHEDULED, values(scheduled(name, config.iterations)), strict=True)) | changes
    for each, value in changes.items():
        config = changed(config, each, value)
    config.check()
    return config


def changed(config: TrainConfig, name: str, value: Any) -> TrainConfig:
    """The settings with another value of one, whose name has a dot after its group's."""
    group, dot, field = name.partition(".")
    return replace(config, **{group: replace(getattr(config, group), **{field: value}) if dot else value})


def paragraph(answers: Sequence[Answer], looked: int, *, auto: bool) -> str:
    """The findings with their answers, for people. looked: number of photographs; auto: whether they are taken."""
    if not answers:
        return f"looked at {looked:,} photographs: nothing found that a setting would answer"
    text = "; ".join(answer.words for answer in answers)
    settings = " ".join(filter(None, (flags(answer.settings) for answer in answers)))
    end = f". --auto {'takes' if auto else 'would take'} {settings}" if settings else ""
    return f"looked at {looked:,} photographs: {text}{end}"
