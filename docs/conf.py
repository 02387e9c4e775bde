"""Sphinx configuration of the site: `make docs` builds it."""

from __future__ import annotations

import re
import sys
from enum import Enum
from functools import cached_property
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import TYPE_CHECKING

from docutils import nodes

if TYPE_CHECKING:
    from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

project = "armsight"
author = "The armsight developers"
project_copyright = "The armsight developers. Apache License 2.0"
release = version = installed_version("armsight")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "_made", "README.md"]
nitpicky = True
# Types of other packages have no inventory here: the site is built without a network.
nitpick_ignore_regex = [
    (r"py:.*", r"(?!armsight\b).*"),
    # Type aliases and private names that appear in signatures only.
    (r"py:(class|obj|data|attr)", r"armsight\.data\.(Array|Image)"),
    # Records inside one subject, named in signatures of public functions; the reference has the public names only.
    (r"py:.*", r"armsight\.vision\.(pose\.)?(bundle|detections|projection|rectify)\.\w+"),
    (
        r"py:.*",
        r"armsight\.(loop\.(estimators\.readings|handeye\.poses|identify\.(fit|model|identify|selection))"
        r"|robot\.trajectories\.limits|tables\.poses|estimate\.change)\.\w+",
    ),
    (
        r"py:.*",
        r"armsight\.vision\.(calibrate\.motion|markers\.(body_file|targets|disc\.target|discs|spec))\.\w+",
    ),
    (r"py:.*", r"armsight\.sim\.(budget\.plan\.CameraClass|camera\.stages\.\w+)"),
]
suppress_warnings = ["config.cache"]  # sphinx-gallery keeps functions in its configuration

smartquotes_action = "qe"  # quotes and ellipses; two hyphens begin an option

# MyST: the pages are CommonMark with tables; headings to the third level can be linked to.
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

# Docstrings
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": False}
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("Array", "Ids", "Image", "Side")}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
python_use_unqualified_type_names = True
add_module_names = False

# Theme: system fonts only; nothing is loaded from another site.
html_theme = "furo"
html_title = "armsight"
html_static_path = ["_static"]
html_css_files = ["armsight.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {"top_of_page_buttons": []}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_only_copy_prompt_lines = True

# Examples become the gallery. `make docs` runs them (-D plot_gallery=1); a plain build shows their code only.
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"[\\/]\d\d_",
    "within_subsection_order": "FileNameSortKey",
    "plot_gallery": "False",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_signature": False,
    "show_memory": False,
    "write_computation_times": False,
    "min_reported_time": 10**9,
}

#: Pictures that `make docs` takes from the runs of the tutorials.
MADE = re.compile(r"\((?:\.\./)?_made/([^)\s]+\.png)\)")


def fill_in_pictures(app: Sphinx) -> None:
    """Put a grey picture where a tutorial's run has not made one yet, so that pages build without running anything."""
    from PIL import Image

    for page in sorted(HERE.rglob("*.md")):
        for name in MADE.findall(page.read_text(encoding="utf-8")):
            picture = HERE / "_made" / name
            if not picture.exists():
                picture.parent.mkdir(parents=True, exist_ok=True)
                Image.new("L", (640, 120), 220).save(picture)


def skip_plain_fields(app: Sphinx, what: str, name: str, member: object, skip: bool, options: object) -> bool | None:
    """Leave out the fields of records: the section Attributes of the class describes them."""
    documented = callable(member) or isinstance(member, (property, cached_property, staticmethod, classmethod, Enum))
    return True if what == "class" and not documented else None


def name_types(
    app: Sphinx, what: str, name: str, member: object, options: object, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Show type aliases by their names also where Sphinx shows its own class for them: ``Image | None``."""
    short = [text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in (signature, returned)]
    return short[0], short[1]


def set_dashes(app: Sphinx, doctree: nodes.document) -> None:
    """Set a dash where Sphinx puts two hyphens between a name and its description."""
    for text in list(doctree.findall(nodes.Text)):
        if " -- " in text and not isinstance(text.parent, (nodes.literal, nodes.literal_block)):
            text.parent.replace(text, nodes.Text(text.replace(" -- ", " \N{EN DASH} ")))


def read_again(app: Sphinx, *_: object) -> list[str]:
    """Return the pages that depend on more than Sphinx sees: the commands are imported when they are named."""
    return ["reference/cli"]


def setup(app: Sphinx) -> None:
    """Hook what the site needs beyond its extensions."""
    app.connect("builder-inited", fill_in_pictures)
    app.connect("autodoc-skip-member", skip_plain_fields)
    app.connect("autodoc-process-signature", name_types)
    app.connect("doctree-read", set_dashes)
    app.connect("env-get-outdated", read_again)
