import numpy as np

from edp.sim import jit


def test_compiles_without_a_writable_cache(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocked))
    jit.cache_folder.cache_clear()
    try:
        assert jit.cache_folder() is None

        @jit.compiled
        def double(x: float) -> float:
            return 2.0 * x

        assert double(1.5) == 3.0
    finally:
        monkeypatch.undo()
        jit.cache_folder.cache_clear()


def test_cache_folder_is_keyed_to_the_sources(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    jit.cache_folder.cache_clear()
    try:
        folder = jit.cache_folder()
        assert folder is not None
        assert folder.parent == tmp_path
        assert folder.is_dir()
    finally:
        monkeypatch.undo()
        jit.cache_folder.cache_clear()


def test_not_a_number_stays_visible():
    @jit.compiled
    def echo(x: float) -> bool:
        return np.isnan(x)

    assert echo(float("nan"))
