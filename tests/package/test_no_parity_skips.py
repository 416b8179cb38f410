"""tests/conftest.py: a skipped parity test fails where parity must be tested; what a clone lacks is left out."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

SKIPPING = """
import pytest

@pytest.mark.parity
def test_skipped():
    pytest.skip("no file")

@pytest.mark.parity
@pytest.mark.skipif(True, reason="no reason")
def test_never_run():
    pass

@pytest.mark.parity
@pytest.mark.xfail(reason="some day")
def test_expected_to_fail():
    assert False

@pytest.mark.parity
def test_passed():
    pass

def test_other():
    pytest.skip("no device")
"""
WHOLE = "import pytest\npytest.importorskip('nothing_of_this_name')\n@pytest.mark.parity\ndef test_one(): pass\n"


@pytest.fixture
def suite(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    for name in ("CI", "PYTEST_ADDOPTS"):
        monkeypatch.delenv(name, raising=False)
    pytester.makeconftest((Path(__file__).parents[1] / "conftest.py").read_text())
    pytester.makeini("[pytest]\nmarkers = parity: as in pyproject.toml\n")
    return pytester


def counts(suite: pytest.Pytester, *options: str) -> dict[str, int]:
    return suite.runpytest_inprocess("-p", "no:cacheprovider", *options).parseoutcomes()


def test_skipped_parity_tests_fail_when_reported_to(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    suite.makepyfile(SKIPPING)
    assert counts(suite) == {"passed": 1, "skipped": 3, "xfailed": 1}
    failing = {"passed": 1, "skipped": 1, "failed": 2, "errors": 1}  # a mark skips while the test is set up
    assert counts(suite, "--no-parity-skips") == failing
    monkeypatch.setenv("CI", "true")
    assert counts(suite) == failing


def test_a_skipped_module_of_parity_tests_fails_too(suite: pytest.Pytester) -> None:
    suite.makepyfile(WHOLE)
    assert counts(suite) == {"skipped": 1}
    assert counts(suite, "--no-parity-skips") == {"errors": 1}
    suite.makepyfile(WHOLE.replace("@pytest.mark.parity", ""))
    assert counts(suite, "--no-parity-skips") == {"skipped": 1}


def test_what_is_not_there_is_left_out_and_named(suite: pytest.Pytester) -> None:
    suite.makepyfile("""
        import pytest

        @pytest.mark.needs(False, "heavy: say so")
        def test_heavy(): pass

        @pytest.mark.needs(True, "nothing")
        def test_light(): pass

        def test_real(kitti_mini): pass
    """)
    result = suite.runpytest_inprocess("-p", "no:cacheprovider")
    assert result.parseoutcomes() == {"passed": 1, "deselected": 2}
    result.stdout.fnmatch_lines(["LEFT OUT *1* heavy: say so", "LEFT OUT *1* real data: unpack them into data/"])
