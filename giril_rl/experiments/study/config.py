"""How a study is run: its own knobs, beside those of its runs."""

from __future__ import annotations

from dataclasses import dataclass

from giril_rl.config.schema import knob


@dataclass
class StudyConfig:
    """What `giril study` takes itself; every other key is a knob of the study's runs."""

    jobs: int | None = knob(
        None,
        "runs at a time; null: one for each core, or CPU of the cluster, and per_gpu for each GPU",
        low=1,
    )
    launcher: str = knob("local", "local processes, or a Ray cluster", choices=("local", "ray"))
    ray_address: str = knob("auto", "the cluster's address; auto: one that runs on this machine")
    per_gpu: int = knob(4, "runs with device=cuda that share a GPU", low=1)
    retries: int = knob(2, "how often a run is started again whose process was killed", low=0)
    root: str = knob("runs", "where runs, experts, demonstrations and studies are kept")
