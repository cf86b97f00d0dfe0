# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import pytest


@pytest.fixture(scope='session')
def solved():
    """Return a problem and what is identified of it."""
    from pages import problem_of

    from calib_ros.identification.identification import identify

    problem = problem_of()
    return problem, identify(problem)
