"""A registered method is one that a reader can run and look up."""

from pathlib import Path

import pytest

from giril_rl.config.recipes import find
from giril_rl.errors import UserError
from giril_rl.methods import controls, methods
from giril_rl.rewards.method import GREY, Method, register, unregister

PAGES = Path(__file__).parents[2] / "docs" / "methods"


@pytest.mark.parametrize("name", [m.name for m in methods().values() if m.kind == "method"])
def test_a_method_has_a_recipe_and_a_page(name):
    assert find(name).docstring.startswith(f"{methods()[name].label}: ")
    assert (PAGES / f"{name}.md").is_file()


def test_a_control_is_on_the_controls_page():
    page = (PAGES / "controls.md").read_text(encoding="utf-8")
    assert [name for name in controls() if f"`{name}`" not in page] == []


def test_two_methods_cannot_have_one_name():
    mine = register(Method("mine", "Mine", GREY))
    assert register(Method("mine", "Mine", GREY)) is not None  # The same again is no conflict.
    with pytest.raises(UserError, match="there is a method mine already"):
        register(Method("mine", "Another", GREY))
    assert methods()["mine"] is mine
    unregister("mine")
    assert "mine" not in methods()
