"""What keeps a unit from recording well, in words, each with what mends it."""

from bricktrack_common.wire_messages import StatusReply
from bricktrack_host.campaign.test_plan import is_of_test


def obstacles(now: StatusReply, name: str = "") -> list[tuple[str, str]]:
    """Return what keeps a unit from recording, each with its remedy; empty for one that is ready.

    Parameters
    ----------
    name : str
        The test that it shall record; a unit that is armed for it already is ready.
    """
    found = [(f"{item.name}: {item.words}", item.remedy) for item in now.health if item.level == "fail"]
    if now.state == "fault":
        found.append((now.reason or now.last_error or "in fault", "'bricktrack disarm' clears it"))
    elif now.state != "idle" and not is_of_test(now.run_id, name):
        found.append((f"{now.state} for {now.run_id}", "Wait, or 'bricktrack disarm'"))
    if now.disk_free_bytes < now.disk_needed_bytes:
        free, needed = now.disk_free_bytes / 1e9, now.disk_needed_bytes / 1e9
        found.append((f"{free:.1f} GB free; a run needs {needed:.1f} GB", "Pull its runs, then delete them"))
    return found
