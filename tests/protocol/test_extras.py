"""What to install is named by its packages: an index need not have cpnet."""

import sys

from protocol.extras import to_install


def test_the_packages_of_an_extra_are_named(monkeypatch) -> None:
    needs = ['polars>=1; extra == "study"', "numpy<3,>=2", 'mcap>=1; extra == "mcap"']
    monkeypatch.setattr("protocol.extras.requires", lambda _: needs)
    monkeypatch.setattr("protocol.extras._is_installed", lambda need: need.startswith("numpy"))
    assert to_install("study") == f"{sys.executable} -m pip install 'polars>=1'"


def test_only_those_that_are_missing(monkeypatch) -> None:
    needs = ["numpy>=2; extra == 'x'", "no-such-package-here[a]~=1; extra == 'x'"]
    monkeypatch.setattr("protocol.extras.requires", lambda _: needs)
    assert to_install("x").endswith("pip install 'no-such-package-here[a]~=1'")
