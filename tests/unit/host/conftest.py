"""What several test modules of the host are tried on."""

import pytest
from campaign_lab import make_campaign
from small_lab import invented_lab


@pytest.fixture(scope="session")
def lab(tmp_path_factory):
    """Two invented runs and their combined test; who writes into it takes a copy."""
    folder = tmp_path_factory.mktemp("lab")
    invented_lab(folder)
    return folder


@pytest.fixture(scope="session")
def campaign(lab, tmp_path_factory):
    """A dataset of the lab's test; to be read, never written."""
    return make_campaign(lab, tmp_path_factory.mktemp("data") / "campaign")
