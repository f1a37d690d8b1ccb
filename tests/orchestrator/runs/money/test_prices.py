from pathlib import Path

import pytest

from panolog.orchestrator.runs.machines.machine import instance_type
from panolog.orchestrator.runs.machines.nodes import Gpu, Node
from panolog.orchestrator.runs.money.prices import PriceList, default_path, find_prices, read_prices, reserved
from panolog.scene.errors import ConfigError

HEAD = 'currency = "EUR"\n\n'
EXAMPLES = Path(__file__).parents[4] / "deploy" / "prices.toml"


def node(**values: object) -> Node:
    return Node("id", **{"host": "desk-1", "cpus": 4, "memory": 2**34, **values})  # type: ignore[arg-type]


def prices(tmp_path: Path, *entries: str) -> PriceList:
    path = tmp_path / "prices.toml"
    path.write_text(HEAD + "\n".join(f"[[machine]]\n{entry}" for entry in entries))
    return read_prices(path)


@pytest.mark.parametrize(
    ("entry", "machine", "matches"),
    [
        ('name = "g5.xlarge"', {"instance": "g5.xlarge"}, True),
        ('name = "g5.xlarge"', {"instance": "g5.2xlarge"}, False),
        ('name = "g5.xlarge"', {}, False),
        ('name = "a"\nhost = "DESK-*"', {}, True),
        ('name = "a"\ngpu = "*L4"', {"gpus": (Gpu("NVIDIA L4"),)}, True),
        ('name = "a"\ngpu = "*L4"\nhost = "other"', {"gpus": (Gpu("NVIDIA L4"),)}, False),
        ('name = "a"\nlabel = "team=x*"', {"labels": (("team", "xy"),)}, True),
        ('name = "a"\ninstance = "g?.xlarge"', {"instance": "g6.xlarge"}, True),
    ],
)
def test_a_machine_is_known_by_its_patterns(
    entry: str, machine: dict[str, object], matches: bool, tmp_path: Path
) -> None:
    found = prices(tmp_path, f"{entry}\nprice = 2").of(node(**machine))
    assert (found is not None) == matches


def test_the_first_entry_counts_and_a_spot_machine_has_its_price(tmp_path: Path) -> None:
    listed = prices(
        tmp_path, 'name = "a"\nhost = "*"\nprice = 2\nspot = 0.5', 'name = "b"\nhost = "*"\nprice = 9'
    )
    assert (reserved(node(), listed).kind, reserved(node(), listed).price) == ("a", 2.0)
    spot = reserved(node(labels=(("ray.io/market-type", "SPOT"),)), listed)
    assert (spot.kind, spot.price) == ("a spot", 0.5)


def test_a_run_pays_its_share_of_a_machine(tmp_path: Path) -> None:
    listed = prices(tmp_path, 'name = "a"\nhost = "*"\nprice = 2')
    record = reserved(node(share=0.25), listed)
    assert (record.kind, record.price) == ("25 % of a", 0.5)
    assert reserved(node(share=0.25), None).price is None


def test_a_machine_without_an_entry_costs_as_much_as_the_dearest(tmp_path: Path) -> None:
    listed = prices(tmp_path, 'name = "x.a"\nprice = 2', 'name = "x.b"\nprice = 9')
    record = reserved(node(), listed)
    assert record.price == 9
    assert "not in the price list: priced as x.b" in record.kind
    assert reserved(node(), None).price is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + '[[machine]]\nname = "a"\nprice = -1\n', "line 5: machine.1.price = -1"),
        (
            HEAD + '[[machine]]\nname = "a"\nprice = 1\n[[machine]]\nname = "b"\nprize = 1\n',
            "line 6: machine.2.price is",
        ),
        (HEAD + '[[machine]]\nname = "a"\nprice = 1\ncolour = 1\n', "line 6: machine.1.colour is no key"),
        (HEAD + '[[machine]]\nname = "a"\nprice = inf\n', "line 5: machine.1.price"),
        (HEAD + "[[machine]\n", r"is not TOML.*line 3"),
        ("currency = 'EUR'\n", "machine is missing"),
        ("currency = '1 2'\nmachine = []\n", "line 1: currency"),
    ],
)
def test_what_is_wrong_in_a_price_file_is_named_with_its_line(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "prices.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_prices(path)


def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        find_prices(str(tmp_path / "none.toml"))
    (tmp_path / "huge.toml").write_bytes(b"#" * 2**19)
    with pytest.raises(ConfigError, match="more than"):
        read_prices(tmp_path / "huge.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="UTF-8"):
        read_prices(tmp_path / "binary.toml")
    with pytest.raises(ConfigError, match="not JSON"):
        find_prices("{")


def test_the_users_own_list_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert find_prices(None) is None
    default_path().parent.mkdir()
    default_path().write_text(HEAD + '[[machine]]\nname = "a"\nprice = 1\n')
    found = find_prices(None)
    assert found is not None
    assert found.currency == "EUR"
    assert find_prices(found.model_dump_json()) == found  # as one command gives it to another


def test_the_examples_are_a_price_list() -> None:
    assert read_prices(EXAMPLES).of(node(instance="g6.xlarge")) is not None


def test_only_what_looks_like_one_is_an_instance_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    product = tmp_path / "product_name"
    for text, found in {"g5.xlarge\n": "g5.xlarge", "Standard PC (Q35)": "", "KVM": ""}.items():
        product.write_text(text)
        assert instance_type(product) == found
    assert instance_type(tmp_path / "none") == ""
    monkeypatch.setenv("PANOLOG_INSTANCE", "Standard_NC6")
    assert instance_type(product) == "Standard_NC6"
