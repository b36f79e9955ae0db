"""Sphinx's settings: pages in Markdown (MyST), the API from docstrings, the furo theme."""

from importlib.metadata import version as installed

from giril_rl.methods import methods

project = "giril_rl"
author = "giril_rl contributors"
release = version = installed("giril-rl")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["dollarmath", "colon_fence", "substitution"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"giril_rl {release}"
exclude_patterns = ["_build"]
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_use_ivar = True
nitpicky = False

pages = {
    name: "controls" if method.kind == "control" else name for name, method in methods().items()
}
rows = [
    f"| [{method.label}](methods/{pages[name]}.md) | {method.trained} |"
    for name, method in methods().items()
]
myst_substitutions = {
    "methods": "\n".join(["| method | its reward model is trained |", "|---|---|", *rows])
}
