"""All that the pages show: Python blocks run, commands are checked, YAML is read, links lead on.

The commands in docstrings, of the package, the recipes and the tutorials, are checked as well.

A page is gone through from top to bottom, in an empty folder and one namespace, after what
``pages.py`` prepares for it. ``giril run`` and ``giril study`` are composed and validated but start
nothing; what else ``giril`` does is done. A block that cannot run says why in the line above it:
``<!-- not run: reason -->``.
"""

import argparse
import ast
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pages
import pytest
import yaml

from giril_rl.cli.command_line import main
from giril_rl.cli.parser import Parser
from giril_rl.config.recipes import Recipe, config_class
from giril_rl.experiments.study.spec import Spec, read_spec

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
BLOCK = re.compile(r"(?:^<!-- not run: (.+) -->\n)?^```(\S*)[^\n]*\n(.*?)^```$", re.M | re.S)
LANGUAGES = {
    "python",
    "sh",
    "yaml",
    "text",
    "bibtex",
    "{toctree}",
    "{eval-rst}",
    "{literalinclude}",
}
ELSEWHERE = {"ray", "pytest", "sphinx-build", "pre-commit"}  # Commands that are not ours.
INLINE = re.compile(r"`(giril (?:run|study|cp|ls|eval|demo|report)\b[^`]*)`")
SHOWN = re.compile(r"^ +((?:giril|python|cp) .+)$", re.M)  # In a docstring.
PLACEHOLDER = re.compile(r"…|\.\.\.")
STAND_INS = {"RECIPE": "giril", "TASK": "hopper", "NAME": "constant", "S": "0"}
CODE = sorted(
    path
    for pattern in ("giril_rl/**/*.py", "recipes/*.py", "docs/tutorials/*.py")
    for path in ROOT.glob(pattern)
)
CHECKED = set()  # Commands that no file of a page's changes.
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def blocks(name):
    """Reason not to run it, language and text of each block."""
    return BLOCK.findall((ROOT / name).read_text(encoding="utf-8"))


def commands(text):
    """The commands of a shell block; one with a here-document is one command of several lines."""
    lines = iter(text.splitlines())
    for line in lines:
        end = re.search(r"<<'(\w+)'", line)
        if end:
            line = "\n".join([line, *iter(lambda: next(lines), end[1]), end[1]])
            yield line
        else:
            yield from line.split(" && ")


def first_of_each(path):
    """A study with one run for each group: shipped ones are planned whole by a test of theirs."""
    spec = read_spec(path)
    groups = []
    for group in spec.groups:
        one = {k: v[0] if isinstance(v, list) and v else v for k, v in group.knobs.items()}
        groups.append(replace(group, recipes=group.recipes[:1], knobs=one))
    return Spec(spec.name, spec.title, tuple(groups))


def docstrings(path):
    """The text of all docstrings of a file."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [n for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, kinds)]
    return "\n\n".join(ast.get_docstring(node) or "" for node in nodes)


def inline(text):
    """The commands in running text that say more than a command's name."""
    for line in dict.fromkeys(INLINE.findall(" ".join(text.split()))):
        words = [STAND_INS.get(word, word) for word in re.split(r"(\W)", line)]
        line = "".join(words)
        least = 3 if line.startswith("giril demo") else 2  # A name alone is no command.
        if len(line.split()) > least and not PLACEHOLDER.search(line):
            yield line


class Parsed(BaseException):
    """A command line was understood; nothing is done."""


def understood(line, monkeypatch):
    """Parses a command of which only the words are known."""

    for name in ("parse_args", "parse_intermixed_args"):

        def parse(parser, argv, name=name):
            raise Parsed(getattr(argparse.ArgumentParser, name)(parser, argv))

        monkeypatch.setattr(Parser, name, parse)
    with pytest.raises((Parsed, SystemExit)):  # The latter after --help.
        main(shlex.split(line)[1:])
    monkeypatch.undo()


@pytest.fixture
def dry(monkeypatch, tmp_path):
    """An empty folder, where ``giril run`` and others do all but their work."""
    done = []

    def load(recipe):
        run = SimpleNamespace(main=lambda config, out: done.append(out))
        run.Config = config_class(recipe)
        return run

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(Recipe, "load", load)
    monkeypatch.setattr("giril_rl.cli.study.read_spec", first_of_each)
    monkeypatch.setattr("giril_rl.training.rescore.evaluate_run", lambda *words: None)
    monkeypatch.setattr("giril_rl.experiments.report.report.write_report", lambda runs, out: out)
    return done


def check(line, capsys):
    """Does or validates one command line as it is shown."""
    words = shlex.split(line.partition("\n")[0], comments=True)
    if not words or words[0] in ELSEWHERE:
        return
    if words[0] in ("mkdir", "cat"):
        subprocess.run(["bash", "-ec", line], check=True)
    elif words[0] == "pip":
        wanted = re.findall(r"\[([\w,]+)\]", line)
        assert all(extra in EXTRAS for extra in ",".join(wanted).split(",") if extra), line
    elif words[0] == "cp":
        shutil.copy(ROOT / words[1], words[2])
    elif words[0] in ("python", "bash"):
        assert (ROOT / words[1]).is_file() or Path(words[1]).is_file(), line
    else:
        assert words[0] == "giril", f"{line}: neither ours nor known, see ELSEWHERE"
        if words[1] == "study" and "--help" not in words:
            words.append("--dry-run")
        known = tuple(words)
        if known in CHECKED:
            return
        if words[1] in ("run", "study") and not any(w.endswith((".py", ".yaml")) for w in words):
            CHECKED.add(known)
        assert main(words[1:]) == 0, f"{line}\n{capsys.readouterr().err}"


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", NAMES)
def test_all_that_a_page_shows_holds(name, dry, monkeypatch, capsys):
    found = [(kind, text) for reason, kind, text in blocks(name) if not reason]
    before, after = pages.OF.get(name, (pages.nothing, pages.nothing))
    names = {"__name__": "page", **(before(monkeypatch, blocks(name)) or {})}
    for kind, text in found:
        assert kind in LANGUAGES, f"a block of {name} has no language, or another one: {kind!r}"
        if kind == "python":
            exec(compile(text, name, "exec"), names)
        elif kind == "sh":
            for line in commands(text):
                check(line, capsys)
        elif kind == "yaml":
            assert yaml.safe_load(text)
    after(names)


def check_inline(text, capsys):
    for line in inline(text):
        words = line.split()
        if words[1] in ("demo", "eval", "report", "ls") or words[2] == "-m":
            with pytest.MonkeyPatch.context() as patch:
                understood(line, patch)
        elif words[1] == "cp" or not words[2].endswith((".py", ".yaml")):  # Files of the reader's.
            check(line, capsys)


@pytest.mark.parametrize("name", NAMES)
def test_commands_in_the_text_hold_too(name, dry, capsys):
    if name in pages.GENERATED:
        pytest.skip("written by `giril report`")
    check_inline(BLOCK.sub("", (ROOT / name).read_text(encoding="utf-8")), capsys)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("folder", ["giril_rl", "recipes", "docs/tutorials"])
def test_commands_in_docstrings_hold_too(folder, dry, monkeypatch, capsys):
    found = 0
    for path in CODE:
        name = path.relative_to(ROOT).as_posix()
        if not name.startswith(folder):
            continue
        text = docstrings(path)
        check_inline(text, capsys)
        before, after = pages.OF.get(name, (pages.nothing, pages.nothing))
        before(monkeypatch, None)
        for line in SHOWN.findall(text):
            check(line, capsys)
            found += 1
        after({})
    assert found or folder != "docs/tutorials"


def test_few_blocks_are_not_run():
    reasons = {(name, reason) for name in NAMES for reason, *_ in blocks(name) if reason}
    assert len(reasons) <= 2, reasons


def test_links_lead_to_files_that_are_there():
    for name in NAMES:
        text = BLOCK.sub("", (ROOT / name).read_text(encoding="utf-8"))
        for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", text):
            assert ((ROOT / name).parent / target).exists(), f"{name}: {target}"


@pytest.mark.parametrize(
    "line", ["giril run girl", "giril run giril ppo.lrr=1", "giril fly", "gril ls"]
)
def test_a_wrong_command_is_found(line, dry, capsys):
    with pytest.raises(AssertionError):
        check(line, capsys)


@pytest.mark.parametrize("line", ["giril eval RUN --epsodes 3", "giril demo fly", "giril report"])
def test_a_command_with_other_words_is_not_understood(line, dry, monkeypatch):
    with pytest.raises(pytest.fail.Exception):
        understood(line, monkeypatch)


def test_the_rooms_of_the_page_are_those_of_the_contract():
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    floors = contract["contracts"][0]["layers"]
    rooms = [
        name.strip().removeprefix("giril_rl.") for floor in floors for name in floor.split("|")
    ]
    page = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
    table = page.partition("## Rooms")[2].partition("## ")[0]
    assert re.findall(r"^\| `(\w+)/?` \|", table, re.M) == rooms
    there = {path.name for path in (ROOT / "giril_rl").iterdir() if (path / "__init__.py").exists()}
    assert there == set(rooms) - {"errors"}
