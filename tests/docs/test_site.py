"""The site builds without a warning, loads nothing from elsewhere, and leaves no command out."""

import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from armsight.app.main import COMMANDS, group

DOCS = Path(__file__).resolve().parents[2] / "docs"
#: Where a page could load something from: not links that a reader follows.
LOADED = re.compile(
    r"<(?:script|img|iframe|source|video|audio|embed)\b[^>]*\bsrc=[\"']?(https?:)?//"
    r"|<link\b(?![^>]*\brel=[\"']?(?:canonical|next|prev|index|search|author))[^>]*\bhref=[\"']?(https?:)?//"
    r"|@import\s+(?:url\()?[\"']?(https?:)?//|url\([\"']?(https?:)?//",
    re.IGNORECASE,
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the site; examples and tutorials are not run here."""
    folder = tmp_path_factory.mktemp("site")
    options = ["-m", "sphinx", "-W", "--keep-going", "-n", "-q"]
    command = [sys.executable, *options, "-d", folder / "doctrees", DOCS, folder / "html"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "html"


def test_nothing_is_loaded_from_elsewhere(site):
    assert LOADED.search('<link rel="stylesheet" href="https://fonts.example/a.css">')
    assert LOADED.search("@import url(//fonts.example/a.css)")
    pages = [path for path in site.rglob("*") if path.suffix in (".html", ".css", ".js")]
    assert len(pages) > 40
    for path in pages:
        text = path.read_text(encoding="utf-8", errors="replace")
        found = LOADED.search(text if path.suffix != ".js" else "")
        assert not found, (path, found)


def test_every_command_and_option_is_in_the_reference(site):
    text = (site / "reference" / "cli.html").read_text(encoding="utf-8")
    plain = re.sub(r"<[^>]+>", "", text)
    context = click.Context(group)
    for name in COMMANDS:
        command = group.get_command(context, name)
        members = command.commands.items() if isinstance(command, click.Group) else [("", command)]
        for sub, member in members:
            assert f"armsight {name} {sub}".strip() in plain
            for option in member.params:
                if isinstance(option, click.Option) and not option.hidden:
                    assert option.opts[-1] in plain, (name, sub, option.opts)


def test_every_public_name_is_in_the_reference(site):
    import armsight

    text = (site / "reference" / "api.html").read_text(encoding="utf-8")
    for name in armsight.__all__:
        assert re.search(rf'id="armsight\.[\w.]*\b{name}"', text), name
