"""The code blocks of the documents, and the marks of the tests before them (see `test_documents.py`)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Block:
    """A block of a page, as it is executed."""

    page: str
    line: int
    language: str
    text: str
    before: list[str] = field(default_factory=list)
    skipped: str | None = None


def blocks(page: str) -> list[Block]:
    found: list[Block] = []
    marks: list[str] = []
    lines = iter(enumerate((ROOT / page).read_text().splitlines(), 1))
    for number, line in lines:
        if mark := re.fullmatch(r"\s*<!-- test: (.*) -->", line):
            marks.append(mark[1])
        elif fence := re.fullmatch(r"(\s*)```(\S*)", line):
            text = []
            for _, line in lines:
                if line.strip() == "```":
                    break
                text.append(line.removeprefix(fence[1]))
            found.append(marked(Block(page, number, fence[2], "\n".join(text) + "\n"), marks))
            marks = []
        elif line.strip():
            assert not marks, f"{page}:{number}: a mark of the tests is not before a block"
    return found


def marked(block: Block, marks: list[str]) -> Block:
    for mark in marks:
        kind, _, rest = mark.partition(" ")
        if kind == "before":
            block.before.append(rest)
        elif kind == "skip":
            assert rest, f"{block.page}:{block.line}: skipped without a reason"
            block.skipped = rest
        elif kind == "replace":
            old, new = rest.split(" => ")
            assert old in block.text, f"{block.page}:{block.line}: nothing to replace: {old}"
            block.text = block.text.replace(old, new)
        else:
            raise AssertionError(f"{block.page}:{block.line}: unknown mark {mark}")
    return block
