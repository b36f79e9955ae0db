from pathlib import Path

import pytest

from giril_rl.config.overrides import parse, sweep
from giril_rl.errors import UserError
from giril_rl.experiments.study.spec import override_text, read_spec, shipped_studies

GROUP = "groups: [{label: a, recipe: fake.py}]\n"


def read(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return read_spec(path)


def test_groups_have_the_knobs_of_all_below_their_own(tmp_path):
    spec = read(
        tmp_path,
        """
title: some runs
all: {steps: 1_000, ppo: {lr: 1e-4, clip: 0.2}}
groups:
  - &first {label: a, recipe: giril, seed: [0, 1], ppo.clip: 0.3}
  - {<<: *first, label: b, recipe: [gail, mine.py], demo: {length: null}}
""",
    )
    assert (spec.name, spec.title) == ("mine", "some runs")
    first, second = spec.groups
    assert first.recipes == ("giril",)
    assert first.knobs == {"steps": 1000, "ppo.lr": 1e-4, "ppo.clip": 0.3, "seed": [0, 1]}
    assert second.recipes == ("gail", "mine.py")
    assert second.knobs == {**first.knobs, "demo.length": None}


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "`groups` is missing"),
        ("- 1", "is not a study: it needs `groups`"),
        ("title: x", "`groups` is missing"),
        ("groups: []", "`groups` is missing"),
        ("groups: [\n", "line 2: "),
        (GROUP + "group: 3", "'group' is not a key of a study; did you mean 'groups'?"),
        (GROUP + "all: 3", "`all` holds knobs"),
        ("groups: [{recipe: giril}]", "group 1 has no label"),
        ("groups: [3]", "group 1 has no label"),
        ("groups: [{label: a}]", "group 'a' has no recipe"),
        ("groups: [{label: a, recipe: []}]", "group 'a' has no recipe"),
        ("groups: [{label: a, recipe: x}, {label: a, recipe: y}]", "two groups have the label 'a'"),
        ("groups: [{label: a, recipe: x, seed: 1, seed: 2}]", "duplicate key seed"),
    ],
)
def test_refusals(tmp_path, text, part):
    with pytest.raises(UserError) as refusal:
        read(tmp_path, text)
    assert part in str(refusal.value)
    assert str(tmp_path / "mine.yaml") in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "k=null"),
        (True, "k=true"),
        (1e-4, "k=0.0001"),
        ("released", "k=released"),
        ("a/b c.yaml", "k=a/b c.yaml"),
        ("it's", "k='it\\'s'"),
        ([1, None], "k=1,null"),
        (["a,b", "c"], "k='a,b',c"),
        ("range(0,3)", "k=range(0,3)"),
    ],
)
def test_a_value_is_written_as_on_the_command_line(value, text):
    assert override_text("k", value) == text
    parse([text])


def test_text_in_quotes_is_read_back_as_it_was():
    for value in ("it's", "old (two), new", "a=b", "{x}"):
        (override,) = parse([override_text("k", value)])
        assert override.value() == value


def test_a_knob_that_is_a_list_sweeps_over_lists():
    assert override_text("k", [16, 16], is_list=True) == "k=[16,16]"
    text = override_text("k", [[16, 16], [8]], is_list=True)
    assert sweep([text]) == [["k=[16,16]"], ["k=[8]"]]


def test_shipped_studies_have_titles():
    studies = shipped_studies()
    assert {"pybullet", "pybullet-ablations", "pybullet-no-survival", "smoke"} <= set(studies)
    for path in studies.values():
        assert 20 < len(read_spec(path).title) < 100
        assert not Path(path.parent.parent, path.name).exists()  # Not taken for a recipe's.
