"""Any text at all, as words of the command line, YAML, JSON or a checkpoint: read or refused."""

import contextlib
import json
from pathlib import Path

import pytest
import yaml
from files import DATA
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from giril_rl.config.compose import resolved
from giril_rl.config.knobs import knobs
from giril_rl.config.overrides import parse
from giril_rl.config.recipes import config_class, find
from giril_rl.errors import UserError
from giril_rl.experiments.study.spec import read_spec
from giril_rl.files.untrusted import parse_json, parse_yaml
from giril_rl.runs.checkpoint import load_state

GIRIL = find("giril")
CONFIG = config_class(GIRIL)
KEYS = st.sampled_from([knob.key for knob in knobs(CONFIG)])
VALUES = st.one_of(
    st.floats().map(str),
    st.integers().map(str),
    st.sampled_from(["null", "true", "[]", "[1,x]", "{a: 1}", "'", "${a", "${oc.env:HOME}", ""]),
    st.text(max_size=20),
)
here = settings(
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def containers(inner):
    return st.lists(inner) | st.dictionaries(st.text(), inner)


def refused(error):
    sentence = str(error)
    assert sentence and sentence[-1] in ".?", sentence


@settings(here, max_examples=40)
@given(st.text(max_size=40))
def test_words_are_parsed_or_refused(text):
    try:
        parse([text])
    except UserError as error:
        refused(error)


@pytest.mark.slow
@settings(here, max_examples=60)
@given(KEYS, VALUES)
def test_any_value_of_any_key_is_taken_or_refused(key, value):
    try:
        resolved(GIRIL, CONFIG, [f"{key}={value}"])
    except UserError as error:
        refused(error)


@settings(here, max_examples=40)
@given(st.floats().filter(lambda number: not 0 < number <= 1))
def test_no_beta_outside_its_range_is_taken(beta):
    from giril_rl.config.validation import validate
    from giril_rl.rewards import GenerativeConfig

    with pytest.raises(UserError, match=r"^beta="):
        validate(GenerativeConfig(beta=beta))


@here
@given(st.text(alphabet="[]{}:,&*!|>-'\"# \na1~", max_size=60))
def test_yaml_is_parsed_or_refused(text):
    with contextlib.suppress(ValueError, yaml.YAMLError):
        parse_yaml(text)


@settings(here, max_examples=60)
@given(st.text(alphabet="[]{}:,&*!-'\" \nagroupslbecipt1", max_size=80))
def test_a_study_is_read_or_refused(tmp_path, text):
    path = tmp_path / "study.yaml"
    path.write_text(text)
    try:
        read_spec(path)
    except UserError as error:
        refused(error)


@here
@given(
    st.recursive(
        st.none() | st.integers() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_json_comes_back(value):
    assert parse_json(json.dumps(value)) == value


@here
@given(st.data())
def test_a_checkpoint_with_any_byte_changed_or_cut_is_read_or_refused(tmp_path, data):
    content = bytearray((DATA / "run/policy/model.safetensors").read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[at] ^= data.draw(st.integers(1, 255))
    else:
        content = content[:at]
    path = Path(tmp_path) / "model.safetensors"
    path.write_bytes(content)
    try:
        load_state(path)
    except UserError as error:
        refused(error)
