"""The direction of data flow, held by the imports: envs -> runner -> replay -> learner -> modules."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "rllib_maobs"
# What each part may import of the others; whatever is not listed may import nothing of them.
FOUNDATION = {"layout", "memory", "options", "paths", "registry"}
ALLOWED = {
    "layout": {"options"},
    "memory": set(),
    "options": set(),
    "paths": set(),
    "registry": {"options"},
    "whole": set(),
    "envs": FOUNDATION,
    "modules": FOUNDATION,
    "replay": {"memory", "options"},
    "runner": {*FOUNDATION, "envs", "modules"},
    "learner": {*FOUNDATION, "modules", "replay"},
    "algorithms": {*FOUNDATION, "envs", "modules", "replay", "runner", "learner", "whole"},
}


def imports(part: str) -> set[str]:
    files = [PACKAGE / f"{part}.py"] if (PACKAGE / f"{part}.py").exists() else list((PACKAGE / part).rglob("*.py"))
    assert files
    found = set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found |= {name.split(".")[1] if "." in name else "face" for name in names if name.startswith("rllib_maobs")}
    return found - {part}


@pytest.mark.parametrize("part", sorted(ALLOWED))
def test_imports_follow_the_flow_of_data(part: str) -> None:
    assert imports(part) <= ALLOWED[part]


def test_scripts_use_the_public_names_only() -> None:
    for file in (PACKAGE.parent / "tuned_examples").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rllib_maobs"):
                assert node.module in ("rllib_maobs", "rllib_maobs.experiment"), f"{file.name}: {node.module}"
