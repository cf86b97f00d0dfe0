# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real Chromium, that of the system."""

import shutil
from contextlib import contextmanager

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
# In software: a machine for tests has no graphics card.
GRAPHICS = ('--use-angle=swiftshader-webgl', '--enable-unsafe-swiftshader')


def browser_path():
    return next(filter(None, map(shutil.which, NAMES)), None)


PATIENCE_MS = 300_000
"""A busy machine draws in software for minutes."""


@contextmanager
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=browser_path(), args=['--no-sandbox', *GRAPHICS]
        )
        context = started.new_context()
        context.set_default_timeout(PATIENCE_MS)
        yield context
        started.close()
