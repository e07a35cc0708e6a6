"""Code that is used stays, whoever else's folders stay, and only what is old goes."""

import os

import pytest

from bricktrack_host.compiled_leftovers import LOOK_AGAIN_S, UNUSED_S, remove_unused_code

NOW_S = 2_000_000_000


@pytest.fixture
def cache(tmp_path):
    def keep(name, *, written_s, read_s):
        inner = tmp_path / name / "tracking_0a1b"
        inner.mkdir(parents=True)
        (inner / "segment.find-12.py311.1.nbc").write_bytes(b"code")
        for path in (inner / "segment.find-12.py311.1.nbc", inner, tmp_path / name):
            os.utime(path, (read_s, written_s))

    old_s, new_s = NOW_S - UNUSED_S - 1, NOW_S - UNUSED_S + 1
    keep("00112233445566aa", written_s=old_s, read_s=old_s)
    keep("00112233445566bb", written_s=old_s, read_s=new_s)
    keep("00112233445566cc", written_s=new_s, read_s=old_s)
    keep("somebody-elses", written_s=old_s, read_s=old_s)
    return tmp_path


def test_only_what_was_long_not_used_goes(cache):
    assert remove_unused_code(cache, now_s=NOW_S) == 1
    kept = {p.name for p in cache.iterdir() if p.is_dir()}
    assert kept == {"00112233445566bb", "00112233445566cc", "somebody-elses"}


def test_the_folders_are_looked_through_only_now_and_then(cache):
    assert remove_unused_code(cache, now_s=NOW_S) == 1
    assert remove_unused_code(cache, now_s=NOW_S + LOOK_AGAIN_S - 1) == 0
    assert remove_unused_code(cache, now_s=NOW_S + LOOK_AGAIN_S + 1) == 2


def test_without_a_cache_there_is_nothing_to_do(tmp_path):
    assert remove_unused_code(tmp_path / "none") == 0
