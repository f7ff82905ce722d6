"""Machine code and where it is kept."""

from __future__ import annotations

import ctypes

from mjx_tt.lanes import machine

TEXT = "define i32 @answer() {\n ret i32 42\n}\n"


def called(folder):
    return ctypes.CFUNCTYPE(ctypes.c_int32)(machine.compiled(TEXT, "answer", folder).value)()


def test_machine_code_is_kept_and_a_damaged_file_is_built_again(tmp_path):
    folder = tmp_path / "lanes"
    assert called(folder) == 42
    (kept,) = folder.iterdir()
    whole = kept.read_bytes()
    assert called(folder) == 42 and kept.read_bytes() == whole
    for damaged in (whole[:-1], b"", whole[:200] + b"x" + whole[201:]):
        kept.write_bytes(damaged)
        assert called(folder) == 42
        assert kept.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_no_obstacle(tmp_path):
    (tmp_path / "lanes").write_text("a file where the folder should be")
    assert called(tmp_path / "lanes") == 42
