import sys
from pathlib import Path

import pytest

from bricktrack_host import compiled as module
from bricktrack_host.compiled import compiled, sources_behind

TRACKING = Path(module.__file__).parent / "tracking"


def names_behind(source):
    return {"/".join(path.parts[-2:]) for path in sources_behind(source)}


def test_code_is_kept_for_what_a_module_imports_however_indirectly():
    behind = names_behind(TRACKING / "refine_kernel.py")
    assert "tracking/led_view.py" in behind
    assert "bricktrack_host/compiled.py" in behind
    assert "tracking/light_kernel.py" not in behind
    # A module taken from a package by name, and what that imports in its turn.
    assert "tracking/light_kernel.py" in names_behind(TRACKING / "segment.py")


@pytest.mark.parametrize("line", ["from bricktrack_host.tracking import finite, light_kernel as k",
                                  "from bricktrack_host.tracking import (\n    finite,\n    light_kernel as k,\n)"])  # fmt: skip
def test_all_names_of_an_import_are_followed(tmp_path, line):
    source = tmp_path / "a.py"
    source.write_text(f"{line}\n")
    behind = {path.name for path in sources_behind(source)}
    assert {"a.py", "finite.py", "light_kernel.py"} <= behind


def test_a_changed_source_is_compiled_in_a_folder_of_its_own(tmp_path, monkeypatch):
    folders = []
    for number in (1, 2):
        source = tmp_path / f"{number}" / "numbers_of.py"
        source.parent.mkdir()
        source.write_text(f"def number():\n    return {number}\n")
        monkeypatch.syspath_prepend(str(source.parent))
        monkeypatch.delitem(sys.modules, "numbers_of", raising=False)
        import numbers_of

        function = compiled(numbers_of.number)
        assert function() == number
        folders.append(module.numba.config.CACHE_DIR)
    assert folders[0] != folders[1]
