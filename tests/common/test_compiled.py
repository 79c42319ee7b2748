"""The cache of compiled functions notices when a helper beside them changes."""

import beamsplat.common.compiled as compiled


def test_a_changed_helper_in_the_folder_changes_the_stamp(tmp_path):
    (tmp_path / "helper.py").write_text("STEP = 1\n")
    before = compiled._digest.__wrapped__(tmp_path)
    assert compiled._digest.__wrapped__(tmp_path) == before
    (tmp_path / "helper.py").write_text("STEP = 2\n")
    assert compiled._digest.__wrapped__(tmp_path) != before


def test_the_stamp_of_a_kernel_is_part_of_its_cache():
    from beamsplat.common.mapfiles import mesh

    kernels = [value for value in vars(mesh).values() if hasattr(value, "py_func")]
    assert kernels
    for kernel in kernels:
        stamp = kernel._cache._cache_file._source_stamp
        assert isinstance(stamp[1], str)
        assert len(stamp[1]) == 64
