# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The contract of the readers, on all that broke it once and on a few variants more."""

import random

import pytest
from fuzz_targets import CORPUS, TARGETS, corpus, keep_contract
from fuzz_variants import variant


@pytest.mark.parametrize('name', TARGETS)
def test_readers_keep_their_contract_on_the_corpus(name):
    for data in corpus(name):
        keep_contract(name, data)


@pytest.mark.parametrize('name', TARGETS)
def test_readers_keep_their_contract_on_variants(name):
    rng, seeds = random.Random(name), corpus(name)
    for _ in range(60):
        keep_contract(name, variant(rng, seeds))


def test_the_corpus_stays_small():
    assert sum(path.stat().st_size for path in CORPUS.rglob('*')) < 1_000_000
    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)
