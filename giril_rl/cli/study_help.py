"""The page of ``giril study --help``."""

from __future__ import annotations

from giril_rl.config.leaves import default_text, leaves
from giril_rl.errors import UserError
from giril_rl.experiments.study.config import StudyConfig
from giril_rl.experiments.study.spec import read_spec, shipped_studies


def study_help() -> str:
    """How the command is called, the shipped studies, and a study's own settings.

    Examples:
        >>> "launcher" in study_help()
        True
    """
    page = ["giril study STUDY [key=value ...] [--dry-run]", ""]
    page.append("Make the runs that a study lists and that have no result yet, several at a time.")
    page.append("The same command continues an interrupted study; --dry-run lists its runs.")
    page += ["", "Studies (or the path of a YAML file of your own)"]
    studies = shipped_studies()
    for name, path in studies.items():
        try:
            title = read_spec(path).title
        except UserError as error:
            title = str(error)
        page.append(f"  {name:<{max(map(len, studies))}}  {title}")
    page += ["", "Settings (key, default, meaning)"]
    default = StudyConfig()
    for leaf in leaves(StudyConfig):
        value = default_text(getattr(default, leaf.key))
        page.append(f"  {leaf.key:<11}  {value:<5}  {leaf.line}")
    page.append("Any other key=value takes the place of that knob in all groups, such as seed=0,1.")
    return "\n".join(page)
