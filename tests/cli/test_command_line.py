import json
import subprocess
import sys
from pathlib import Path

import pytest

from giril_rl.cli.command_line import main
from giril_rl.config import recipes
from giril_rl.config.knobs import knobs
from giril_rl.config.recipes import config_class
from giril_rl.config.schema import AveragedRunConfig

FAKE = '''"""Fake: writes what it was given.

A second paragraph."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from giril_rl.config.schema import RunConfig, knob
from giril_rl.errors import UserError


@dataclass
class Config(RunConfig):
    width: int = knob(4, "a number of this recipe's own", low=1)
    crash: str = knob("no", "how to fail", choices=("no", "user", "bug", "stop"))


def main(cfg: Config, out: Path) -> None:
    if cfg.crash == "user":
        raise UserError("the demonstration is empty: record a longer one.")
    if cfg.crash == "bug":
        raise RuntimeError("boom")
    if cfg.crash == "stop":
        raise KeyboardInterrupt
    assert type(cfg) is Config
    out.mkdir(parents=True)
    (out / "config.json").write_text(json.dumps(asdict(cfg)))
'''
SETTINGS = """
defaults:
  - recipe_schema
  - task: inverted_pendulum
  - _self_
steps: 20000
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("fake.py").write_text(FAKE)
    Path("fake.yaml").write_text(SETTINGS)
    return "fake.py"


def read(folder):
    return json.loads(Path(folder, "config.json").read_text())


def test_ls_names_every_recipe_with_its_first_line(capsys):
    assert main(["ls"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [recipe.name for recipe in recipes.shipped()]
    assert {"giril", "expert", "control"} <= {line.split()[0] for line in lines}
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize(
    ("argv", "absent"),
    [
        (["ls"], {"torch", "torchrl", "hydra", "gymnasium"}),
        (["--help"], {"torch", "torchrl", "hydra", "gymnasium"}),
        (["run", "giril", "--help"], {"torch", "torchrl", "gymnasium"}),
        (["run", "giril", "seed=x"], {"torch", "torchrl", "gymnasium"}),
        (["demo", "show", "nowhere"], {"torch", "torchrl", "hydra", "gymnasium", "PIL"}),
        (["study", "--help"], {"torch", "torchrl", "hydra", "gymnasium", "ray"}),
        (["study", "smoke", "seed=x"], {"torch", "torchrl", "gymnasium", "ray"}),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_nothing_heavy_is_imported_before_a_run(argv, absent):
    code = f"import sys, giril_rl.cli.command_line as c; c.main({argv!r})"
    code += "; print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not absent & set(done.stderr.split())


def test_module_runs_as_a_script_and_returns_its_exit_code():
    command = [sys.executable, "-m", "giril_rl", "run", "girl"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "giril: 'girl' is not a recipe; did you mean 'giril'?\n"


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["rnu"], "'rnu' is not a command; did you mean 'run'?"),
        (["zzz"], "'zzz' is not a command: choose one of ls, cp, run, eval, demo, study, report."),
        (["run"], "name a recipe: `giril ls` shows them."),
        (["run", "girl"], "'girl' is not a recipe; did you mean 'giril'?"),
        (["run", "none.py"], "there is no file none.py; `giril cp RECIPE none.py` makes one."),
        (["run", "giril", "--foo"], "unrecognized arguments: --foo; see `giril run --help`."),
        (["run", "giril", "-m", "seed=0,x"], "seed=x: a whole number is needed."),
        (["cp", "giril"], "the following arguments are required: FILE; see `giril cp --help`."),
        (["cp", "giril", "a.txt"], "a.txt does not end in .py: a recipe is a Python file."),
        (["cp", "giril", "no/a.py"], "no/a.py cannot be written: there is no folder no."),
        (["cp", "girl", "a.py"], "'girl' is not a recipe; did you mean 'giril'?"),
        (["eval", "nowhere"], "there is no run folder nowhere."),
        (["eval", ".", "--episodes", "0"], "--episodes 0: at least 1 is needed."),
        (
            ["eval", ".", "--seed", "99999999999999999999999"],
            "--seed 99999999999999999999999: at most 9223372036854775807 is possible.",
        ),
        (
            ["run", "giril", "seed=99999999999999999999999"],
            "seed=99999999999999999999999 must be less than or equal to 9223372036854775807.",
        ),
        (
            ["eval", ".", "--import", "my_envs"],
            "there is no module my_envs among the installed packages or in HERE: install it, or "
            "put it there.",
        ),
        (
            ["run", "giril", "-m", "profile=released", "eval.episodes=5,6"],
            "two jobs are the same run, runs/giril/inverted_pendulum/default/seed0: leave one of "
            "them out.",
        ),
        (["study"], "name a study: `giril study --help` shows them."),
        (["study", "smok"], "'smok' is not a study; did you mean 'smoke'?"),
        (["study", "no.yaml"], "there is no file no.yaml: write the study there, or name another."),
        (["study", "smoke", "jobs=0"], "jobs=0 must be greater than or equal to 1, or null."),
        (["study", "smoke", "launcher=slurm"], "launcher=slurm must be 'local' or 'ray'."),
        (["report", "nowhere"], "there is no folder nowhere."),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_refusals(argv, sentence, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    assert refused(*argv) == sentence.replace("HERE", str(tmp_path))


def test_traceback_is_shown_when_asked_for(capsys):
    assert main(["run", "girl", "--traceback"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("Traceback")
    assert error.endswith("giril: 'girl' is not a recipe; did you mean 'giril'?\n")


@pytest.mark.parametrize("recipe", recipes.shipped(), ids=lambda recipe: recipe.name)
def test_help_shows_every_knob_with_default_and_help(recipe, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert main(["run", recipe.name, "--help"]) == 0
    page = capsys.readouterr().out
    words = " ".join(page.split())
    lines = {line.split()[0]: line.split() for line in page.splitlines() if line.startswith("  ")}
    for knob in knobs(config_class(recipe)):
        assert knob.help, knob.key
        assert knob.help in words
        assert len(lines[knob.key]) >= 3
    assert "inverted_pendulum (default)" in page
    assert ("released (default)" in page) == issubclass(config_class(recipe), AveragedRunConfig)


def test_help_follows_overrides(capsys):
    main(["run", "giril", "task=gymnasium", "steps=77", "--help"])
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip()]
    values = {row[0]: row[1] for row in rows if len(row) > 1}
    assert values["steps"] == "77"
    assert values["task.env_id"] == values["task.name"] == "(needed)"


@pytest.mark.parametrize("argv", [["--help"], [], ["run", "--help"]])
def test_usage(argv, capsys):
    assert main(argv) == 0
    assert "giril run" in capsys.readouterr().out


def test_copy_runs_with_its_own_changed_default(fake, monkeypatch, refused):
    assert main(["cp", "gail", "mine.py"]) == 0
    shipped = recipes.find("gail")
    assert Path("mine.py").read_text() == shipped.path.read_text()
    assert refused("cp", "gail", "mine.py").startswith("mine.py exists")
    Path("mine.py").write_text(FAKE.replace("knob(4", "knob(5"))
    settings = Path("mine.yaml").read_text() + "\nppo: {lr: 0.25}\n"
    Path("mine.yaml").write_text(settings)
    assert main(["run", "mine.py", "task=inverted_double_pendulum", "seed=2"]) == 0
    kept = read("runs/mine/inverted_double_pendulum/default/seed2")
    assert (kept["width"], kept["ppo"]["lr"], kept["seed"]) == (5, 0.25, 2)
    assert kept["steps"] == 1_000_000


def test_a_copy_whose_runs_would_have_another_recipes_name_is_refused(fake, refused):
    assert main(["cp", "giril", "gail.py"]) == main(["cp", "control", "mine.py"]) == 0
    assert refused("run", "gail.py") == (
        "gail.py has the name of the recipe gail, whose runs its own would be taken for: rename "
        "both files."
    )
    text = Path("mine.py").read_text()
    Path("mine.py").write_text(text.replace("recipe=Path(__file__).stem", 'recipe="control"'))
    line = text[: text.index("recipe=Path")].count("\n") + 1
    assert refused("run", "mine.py") == (
        f"{Path('mine.py').resolve()}, line {line}: its runs would be called 'control', not "
        "'mine' as the file: write recipe=Path(__file__).stem."
    )


def test_a_config_that_needs_its_whole_file_is_found(fake):
    python = FAKE.replace("width: int = knob(4", "width: int = knob(FOUR")
    early = "globals().update(FOUR=6)\n\n\n@dataclass\nclass Config"
    Path(fake).write_text(python.replace("@dataclass\nclass Config", early))
    assert main(["run", fake, "out=o"]) == 0
    assert read("o")["width"] == 6


def test_imports_of_main_alone_are_not_run_for_help_and_refusals(fake, capsys, refused):
    python = FAKE.replace("import json\n", "import json\nimport not_installed_here\n")
    Path(fake).write_text(python)
    assert main(["run", fake, "--help"]) == 0
    assert "width" in capsys.readouterr().out
    assert refused("run", fake, "width=x") == "width=x: a whole number is needed."
    here = Path.cwd()
    assert refused("run", fake) == (
        f"{here}/fake.py imports not_installed_here, and there is no such module among the "
        f"installed packages or in {here}: install it, or put it there."
    )


def test_a_group_beside_a_copy_adds_to_the_shipped_one(fake):
    Path("task").mkdir()
    Path("task/mine.yaml").write_text("name: mine\nenv_id: Mine-v0\n")
    assert main(["run", fake, "task=mine", "out=o"]) == 0
    assert read("o")["task"]["env_id"] == "Mine-v0"


def test_a_folder_with_odd_characters_is_no_obstacle(fake, tmp_path, monkeypatch):
    folder = tmp_path / "my runs, (old)"
    folder.mkdir()
    for name in ("fake.py", "fake.yaml"):
        (folder / name).write_text((tmp_path / name).read_text())
    monkeypatch.chdir(folder)
    assert main(["run", str(folder / "fake.py"), "out=o"]) == 0
    assert read("o")["steps"] == 20000


@pytest.mark.parametrize(
    ("python", "settings", "part"),
    [
        (FAKE, None, "needs its settings in bad.yaml"),
        (FAKE, SETTINGS + "foo: 1\n", "'foo' is not a key of bad.py"),
        (FAKE, SETTINGS + "ppo: {lr: x}\n", "ppo.lr=x: a number is needed"),
        (FAKE, SETTINGS + "a: [\n", "is not valid YAML, line"),
        (FAKE, "steps: 3\n", "needs a `defaults` list with `recipe_schema` in it"),
        (FAKE, SETTINGS.replace("inverted_pendulum", "nothing"), "cannot be composed: "),
        (FAKE.replace("def main", "def start"), SETTINGS, "has no `main(cfg, out)`"),
        (FAKE.replace("(RunConfig)", ""), SETTINGS, "has no `Config`"),
        (FAKE.split('"""', 2)[2], SETTINGS, "begins with no docstring"),
        (FAKE + "\n(", SETTINGS, "is not valid Python"),
    ],
)
def test_broken_copies_are_refused(python, settings, part, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    Path("bad.py").write_text(python)
    if settings is not None:
        Path("bad.yaml").write_text(settings)
    assert part in refused("run", "bad.py")


def test_sweep_runs_every_combination(fake, capsys):
    assert main(["run", fake, "-m", "seed=0,1", "width=2,3"]) == 0
    folders = {path.parent.as_posix() for path in Path("runs").rglob("config.json")}
    place = "runs/fake/inverted_pendulum"
    assert folders == {f"{place}/width={width}/seed{seed}" for width in (2, 3) for seed in (0, 1)}
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "[1/4] fake.py seed=0 width=2"
    assert len(lines) == 4


def test_sweep_goes_on_after_a_failure_and_lists_it(fake, capsys):
    assert main(["run", fake, "crash=user,bug,no", "--multirun"]) == 1
    captured = capsys.readouterr()
    assert Path("runs/fake/inverted_pendulum/default/seed0/config.json").is_file()
    assert "giril: the demonstration is empty: record a longer one.\n" in captured.err
    assert "RuntimeError: boom" in captured.err
    tail = ["giril: 2 of 3 jobs failed:", "  fake.py crash=user", "  fake.py crash=bug"]
    assert captured.err.splitlines()[-3:] == tail


def test_sweep_refuses_before_the_first_job(fake, refused):
    assert refused("run", fake, "-m", "width=1,0") == "width=0 must be greater than or equal to 1."
    text = "two jobs would share the folder o: leave out= to giril, or vary it."
    assert refused("run", fake, "-m", "seed=1,2", "out=o") == text
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("crash", "code", "error"),
    [
        ("user", 2, "giril: the demonstration is empty: record a longer one.\n"),
        ("stop", 130, "giril: interrupted.\n"),
    ],
)
def test_exit_codes_of_a_run(fake, crash, code, error, capsys):
    assert main(["run", fake, f"crash={crash}"]) == code
    assert capsys.readouterr().err == error


def test_a_bug_shows_its_traceback(fake, capsys):
    assert main(["run", fake, "crash=bug"]) == 1
    assert capsys.readouterr().err.rstrip().endswith("RuntimeError: boom")


def test_eval_hands_its_arguments_on(tmp_path, monkeypatch):
    import types

    calls = []
    module = types.ModuleType("giril_rl.training.rescore")
    module.evaluate_run = lambda *arguments: calls.append(arguments)
    monkeypatch.setitem(sys.modules, "giril_rl.training.rescore", module)
    assert main(["eval", str(tmp_path), "--episodes", "3"]) == 0
    assert main(["eval", str(tmp_path), "--seed", "0"]) == 0
    assert calls == [(tmp_path, 3, None), (tmp_path, None, 0)]
