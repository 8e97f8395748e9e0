"""MANO files: what is read, and what a file can not make this program do."""

from __future__ import annotations

import os
import pickle
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from graspd_core.errors import HandError
from graspd_core.hands.library import load_hand
from graspd_core.hands.mano.mano_file import ADMITTED, numbers, read_mano, read_pickle
from graspd_core.runtime.inert_pickle import Maker

SYNTHETIC = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks" / "mano_synthetic.py"))


@pytest.fixture(scope="module")
def model() -> dict[str, Any]:
    return SYNTHETIC["synthetic_model"](seed=3)


def write(path: Path, content: dict[str, Any]) -> Path:
    path.write_bytes(SYNTHETIC["mano_pickle"](content))
    return path


def test_everything_is_read_back(model: dict[str, Any], tmp_path: Path) -> None:
    path = write(tmp_path / "MANO_RIGHT.pkl", model)
    # The file names what a licensed one names, chumpy's expression included.
    assert b"chumpy.reordering\nSelect" in path.read_bytes()
    data = read_mano(path)
    np.testing.assert_array_equal(data.template, model["v_template"])
    np.testing.assert_array_equal(data.shape_directions, model["shapedirs"])
    np.testing.assert_array_equal(data.pose_directions, model["posedirs"])
    np.testing.assert_array_equal(data.joint_regressor, model["J_regressor"].toarray())
    np.testing.assert_array_equal(data.weights, model["weights"])
    np.testing.assert_array_equal(data.faces, model["f"])
    np.testing.assert_array_equal(data.components, model["hands_components"])
    np.testing.assert_array_equal(data.mean, model["hands_mean"])


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4])
def test_every_protocol_and_both_sparse_kinds(model: dict[str, Any], tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "hand.pkl"
    rows = csr_matrix(model["J_regressor"])
    fortran = np.asfortranarray(model["weights"].astype(">f4"))
    path.write_bytes(pickle.dumps({**model, "J_regressor": rows, "weights": fortran}, protocol=protocol))
    data = read_mano(path)
    np.testing.assert_array_equal(data.joint_regressor, model["J_regressor"].toarray())
    np.testing.assert_array_equal(data.weights, model["weights"].astype(np.float32))


def test_an_array_as_python_2_wrote_it(tmp_path: Path) -> None:
    """Protocol 2 of Python 2 has raw bytes as text: written here by hand."""
    values = np.array([[1.5, -2.0, 0.25], [200.0, 0.0, 7e-300]])
    raw = values.tobytes()
    path = tmp_path / "two.pkl"
    path.write_bytes(
        b"\x80\x02}U\x01xcnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x02K\x03\x86cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xff"
        b"K\x00tb\x89U" + bytes([len(raw)]) + raw + b"tbs."
    )
    np.testing.assert_array_equal(numbers(read_pickle(path)["x"]), values)


class Evil:
    """Pickles as a call of a function of one's choice."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def test_a_malicious_file_is_refused_and_runs_nothing(model: dict[str, Any], tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    command = f"touch {witness}"
    shell = f"{os.system.__module__}.system"
    cases: dict[str, tuple[Any, str]] = {
        "system": (Evil(os.system, command), shell),
        "eval": (Evil(eval, f"open({str(witness)!r}, 'w')"), "builtin.*eval"),
        "nested": ({"a": [(Evil(os.system, command),)]}, shell),
        "open": (Evil(open, str(witness), "w"), "io.open"),
        "getattr": (Evil(getattr, Evil(__import__, "os"), "system"), "__import__|getattr"),
        "numpy": (Evil(np.load, str(witness)), "load"),
        "fromfunction": (Evil(np.fromfunction, "x", (3,)), "fromfunction"),
        "unpickler": (Evil(pickle.loads, pickle.dumps(Evil(os.system, command))), "pickle.*loads"),
        "code": (Evil(compile, "1", "x", "eval"), "compile"),
    }
    for name, (payload, culprit) in cases.items():
        for protocol in (0, 2, 4):
            path = tmp_path / f"{name}.pkl"
            path.write_bytes(pickle.dumps({**model, "bs_style": payload}, protocol=protocol))
            with pytest.raises(HandError, match=rf"{name}.pkl: asks for .*({culprit}).*refused") as caught:
                load_hand(path)
            assert "\n" not in str(caught.value)
    assert not witness.exists()


@pytest.mark.parametrize(
    "content",
    [
        b"cchumpy.ch\nCh\n}S'x'\nI1\nsb.",  # a state for a class, not for an object
        b"ccopy_reg\n_reconstructor\n}S'__class__'\nI1\nsb.",  # attributes of an admitted function
        b"ccopy_reg\n_reconstructor\n(N}S'call'\nI1\nstb.",  # the same by slots
        b"ccopy_reg\n_reconstructor\n(S'x'\ntR.",  # an object of no class
        b"c_codecs\nencode\n(S'x'\nS'rot13'\ntR.",  # another encoding
        b"Pother\n.",  # something outside the file
        b"\x80\x02\x82\x01.",  # a name by its number in a registry
        b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\x00\x00.",  # 280 TB of memory, please
        b"N\x72\xff\xff\xff\x7f.",  # a memo of two thousand million slots: its C reader allocates them
        b"",
        b"PK\x03\x04 a zip file",
        b"\x80\x63.",
        b"I1\n" * 3,
        b"\x80\x02})" + b"2\x86" * 200 + b"Ns.",  # a key whose hash takes 2^200 steps
        b"\x80\x02})" + b"\x85" * 500_000 + b"Ns.",  # one whose hash takes more stack than there is
        b"\x80\x02(" + b")" + b"2\x86" * 200 + b"Nd.",  # the same in the three other ways to write a key
        b"\x80\x02}()" + b"2\x86" * 200 + b"Nu.",
        b"\x80\x04\x8f()" + b"2\x86" * 200 + b"\x90.",
        b"\x80\x04()" + b"2\x86" * 200 + b"\x91.",
        b"Np" + str(2**61 - 1).encode() + b"\n.",  # places in the memo that have one hash
        b"\x80\x02\x8a\x09" + (2**61 - 1).to_bytes(9, "little") + b"p0\n}(g0\nNu.",
        b"\x80\x02cnumpy\ndtype\nq\x00(" + b"N" * 1000 + b"tR.",  # arguments that every call copies
        b"cmodule\x1b[2J\nname\n.",  # a name that clears the screen
    ],
)
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.pkl"
    path.write_bytes(content)
    with pytest.raises(HandError, match=r"broken.pkl: ") as caught:
        read_mano(path)
    assert "\n" not in str(caught.value)


def test_nothing_admitted_is_a_real_class_or_function() -> None:
    assert all(type(made) is Maker for made in ADMITTED.values())


def test_a_missing_or_huge_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HandError, match=r"MANO_RIGHT.pkl: cannot be read: No such file"):
        load_hand(tmp_path / "MANO_RIGHT.pkl")
    path = tmp_path / "huge.pkl"
    with path.open("wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(HandError, match=r"huge.pkl: more than 64 MB"):
        load_hand(path)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("v_template", None, "v_template: holds NoneType where numbers are expected"),
        ("v_template", np.zeros((5, 2)), r"v_template is 5 x 2, expected any x 3"),
        ("posedirs", np.zeros((5, 3, 135)), r"posedirs is 5 x 3 x 135, expected \d+ x 3 x 135"),
        ("weights", "half", "weights: holds str"),
        ("hands_mean", np.full(45, np.nan), "hands_mean has entries that are not finite"),
        ("hands_mean", np.array([None] * 45), "hands_mean: holds an array of 'O8'"),
        ("f", np.array([[0, 1, 10**6]]), "f: names vertices outside"),
        ("kintree_table", np.zeros((2, 16)), "kintree_table is not MANO's tree"),
    ],
)
def test_a_wrong_entry_is_named(model: dict[str, Any], tmp_path: Path, key: str, value: Any, message: str) -> None:
    with pytest.raises(HandError, match=message):
        read_mano(write(tmp_path / "hand.pkl", {**model, key: value}))


def test_a_missing_entry_and_bad_sums_are_named(model: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(HandError, match=r"hands_mean is missing; the file has .*v_template"):
        read_mano(write(tmp_path / "hand.pkl", {k: v for k, v in model.items() if k != "hands_mean"}))
    for key in ("weights", "J_regressor"):
        with pytest.raises(HandError, match=f"{key}: rows do not sum to one"):
            read_mano(write(tmp_path / "hand.pkl", {**model, key: 2 * model[key]}))
    lost = model["weights"].copy()
    lost[:, [3, 2]] = np.column_stack([np.zeros(len(lost)), lost[:, 2] + lost[:, 3]])
    with pytest.raises(HandError, match="no vertex belongs to index3"):
        read_mano(write(tmp_path / "hand.pkl", {**model, "weights": lost}))


def test_expressions_and_matrices_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    cyclic = b"(dS'x'\nccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nobject\nNtRp1\n(dS'x'\ng1\nsbs."
    path = tmp_path / "x.pkl"
    path.write_bytes(cyclic)
    with pytest.raises(ValueError, match="nested more than 8 deep"):
        numbers(read_pickle(path)["x"])
    sparse = csr_matrix(np.eye(3))
    for change, message in (
        ({"indices": np.array([0, 1, 7])}, "does not fit together"),
        ({"_shape": (3, 10**12)}, "larger than any of MANO's"),
        ({"_shape": (3.5, 3)}, "sparse matrix of shape"),
    ):
        broken = csr_matrix(sparse)
        vars(broken).update(change)
        path.write_bytes(pickle.dumps(broken, protocol=2))
        with pytest.raises(ValueError, match=message):
            numbers(read_pickle(path))


def array(code: bytes, raw: bytes, shape: bytes = b"K\x01\x85") -> bytes:
    """An array in protocol 2, of a type by its code."""
    text = b"X" + len(code).to_bytes(4, "little") + code
    content = b"T" + len(raw).to_bytes(4, "little") + raw
    head = b"cnumpy.core.multiarray\n_reconstruct\n)R(K\x01"
    return head + shape + b"cnumpy\ndtype\n" + text + b"\x85R\x89" + content + b"tb"


def sparse(starts: bytes, indices: bytes = b"i4") -> bytes:
    """A matrix of two columns and three entries."""
    parts = {"data": array(b"f8", bytes(24), b"K\x03\x85"), "indices": array(indices, bytes(12), b"K\x03\x85"),
             "indptr": starts, "_shape": b"K\x02K\x02\x86"}  # fmt: skip
    state = b"".join(b"X" + len(k).to_bytes(4, "little") + k.encode() + v for k, v in parts.items())
    return b"cscipy.sparse.csc\ncsc_matrix\n)R}(" + state + b"ub"


# Lists in lists: two hundred bytes that take 2^60 characters to write out.
LISTS = b"]" + b"".join(b"q" + bytes([i]) + b"0](h" + bytes([i]) + b"h" + bytes([i]) + b"e" for i in range(60))


@pytest.mark.parametrize(
    "content",
    [
        array(b"f3", bytes(8)),
        array("f\u00b2".encode(), bytes(8)),
        array(b"O8", bytes(8)),
        array(b"f8", bytes(8), b"(" + b"K\x01" * 40 + b"t"),
        array(b"f8", bytes(8)).replace(b"X\x02\x00\x00\x00f8", LISTS),
        b"\x8b\xc8\x00\x00\x00" + b"\x7f" * 200,
        b"(K\x01\x8b\xc8\x00\x00\x00" + b"\x7f" * 200 + b"l",
        sparse(array(b"u4", np.array([0, 5, 3], np.uint32).tobytes(), b"K\x03\x85")),
        sparse(array(b"i4", np.array([0, 3, 3], np.int32).tobytes(), b"K\x03\x85"), indices=b"f4"),
        sparse(array(b"f4", np.array([0, 3, 3], np.float32).tobytes(), b"K\x03\x85")),
        sparse(array(b"i4", np.array([0, 3, 3], np.int32).tobytes(), b"K\x03\x85")).replace(b"K\x02K\x02\x86", LISTS),
    ],
)
def test_numbers_that_are_none_are_refused_in_one_short_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "odd.pkl"
    path.write_bytes(b"\x80\x02}X\x0a\x00\x00\x00v_template" + content + b"s.")
    with pytest.raises(HandError, match=r"odd.pkl: v_template: ") as caught:
        read_mano(path)
    assert len(str(caught.value)) < 400
