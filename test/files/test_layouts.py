# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Presets and expressions of columns."""

import pytest

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.files.layouts import Expression, layout_of, load_layout, presets


def test_later_columns_may_use_our_names_of_earlier_ones():
    """As messages about a wrong setting name them."""
    given = ['q*=J*', 'q1=q2,q2=q1', 'q2=q2-{q1},target=q1']
    columns = layout_of('', given, {}).columns
    assert (columns['q1'], columns['q2']) == ('(J2)', '((J1))-{q1}')
    assert columns['target'] == 'q1'
    coupled = layout_of('fanuc', ['q3=q3-q2'], {}).columns['q3']
    assert coupled == '(J3 + J2)-(J2)'


def test_every_preset_says_where_its_format_is_documented():
    assert len(presets()) >= 11
    for name in presets():
        layout = load_layout(name)
        assert layout.description
        assert layout.source
        for each in layout.columns.values():
            Expression.parse(each)


def test_presets_of_users_and_their_faults(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('length: mm\ncolumns: {x: 2*A}\n')
    assert load_layout(str(path)).columns == {'x': '2*A'}
    for text, error in (
        ('lenght: mm', UnknownNameError),
        ('length: ell', ConfigError),
        ('columns: {w: A}', ConfigError),
        ('columns: [1]', ConfigError),
        ('inverse: 3', ConfigError),
        ('euler: XXY', ConfigError),
        ('- 1', ConfigError),
    ):
        path.write_text(text)
        with pytest.raises(error):
            load_layout(str(path))
    with pytest.raises(UnknownNameError, match='optitrack'):
        load_layout('optitrak')


@pytest.mark.parametrize(
    'text', ['a**b', 'f(x)', 'a b', '1+', '__import__("os")', '{}', '', 'a;b']
)
def test_what_is_no_expression(text):
    with pytest.raises(ConfigError, match='not an expression'):
        Expression.parse(text)
