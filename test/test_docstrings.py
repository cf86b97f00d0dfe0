# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What every public function tells."""

import ast
import re
from pathlib import Path

from test_architecture import parsed

PACKAGE = Path(__file__).parents[1] / 'calib_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))


def public_functions(body):
    """Yield the public functions of a module or class, and of its public classes."""
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith('_'):
            yield from public_functions(node.body)
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith('_'):
            yield node


def test_public_functions_of_arrays_give_their_shapes():
    for path in MODULES:
        for function in public_functions(parsed(path).body):
            arguments = [*function.args.args, *function.args.kwonlyargs]
            kinds = [each.annotation for each in arguments] + [function.returns]
            kinds = ' '.join(ast.unparse(each) for each in kinds if each)
            if not re.search(r'\b(FloatArray|NDArray|Index|Flags)\b', kinds):
                continue
            text, where = ast.get_docstring(function) or '', f'{path.stem}.{function.name}'
            assert re.search(r'\((\.{3}|\w[\w +]*,)[^)]*\)', text), f'{where}: (N, n), ...?'
