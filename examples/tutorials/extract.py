# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the blocks of docs/tutorials as files, one script for each page, in its order."""

import re
from pathlib import Path

FOLDER = Path(__file__).parent
PAGES = sorted(
    path for path in FOLDER.parents[1].glob('docs/tutorials/*.md') if path.stem != 'index'
)
HEAD = '# From docs/tutorials/{name}, by extract.py.\n'


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return language and code of the blocks of a page that are meant to be run."""
    return re.findall(r'^```(sh|python)\n(.*?)^```$', page.read_text(), re.M | re.S)


def examples(page: Path) -> dict[Path, str]:
    """Return the script of a page by its path; its Python stands in here-documents."""
    parts = ['#!/bin/sh\n', HEAD.format(name=page.name), 'set -e\n']
    for language, code in blocks(page):
        parts.append(f"python3 - <<'END'\n{code}END\n" if language == 'python' else code)
    return {FOLDER / f'{page.stem}.sh': ''.join(parts)}


if __name__ == '__main__':
    for page in PAGES:
        for path, text in examples(page).items():
            path.write_text(text)
            path.chmod(0o755)
