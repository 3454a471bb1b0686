"""Does what the README shows run as it stands?"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"```(?:yaml|python)\n# (?P<file>\S+)\n(?P<text>.*?)```", re.DOTALL)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder with the README's files, each under the name its first line gives."""
    folder = tmp_path_factory.mktemp("readme")
    for block in BLOCK.finditer((ROOT / "README.md").read_text(encoding="utf-8")):
        (folder / block["file"]).write_text(block["text"], encoding="utf-8")
    return folder


def call(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ,
        check=False,
    )


@pytest.mark.parametrize("campaign", ["first", "flywheel"])
def test_a_campaign_of_the_readme_is_accepted_and_reported(written, campaign):
    ended = call(written, "-m", "harness", "run", f"{campaign}.yaml", "--out", f"runs/{campaign}", "--jobs", "1")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert (written / "runs" / campaign / "report.html").is_file()
    accepted = call(written, "-m", "pytest", "-q", f"runs/{campaign}")
    assert accepted.returncode == 0, accepted.stdout + accepted.stderr
    if campaign == "first":
        read = call(written, "read_a_record.py")
        assert read.returncode == 0, read.stderr
        assert len(read.stdout.splitlines()) == 6


def test_files_that_the_documents_point_to_are_there():
    for document in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        named = re.findall(r"\]\(([^)#:]+)\)", text) + re.findall(
            r"`((?:fmus|harness|observers|reports|tests)/[\w/.]+)`", text
        )
        assert [name for name in named if not (ROOT / name).exists()] == []
