"""From another computer: who is admitted, who is not, and what is refused before anything is opened."""

import stat

import pytest
from served import PATIENCE_S, SMALL_BENCH, served
from wires import stereotome

from acquire.client import Instrument
from acquire.keys import ClientKeys, KeysError, ServerKeys, keys
from acquire.meeting import addresses, host_and_port
from devices.errors import InputError


@pytest.fixture
def folder(tmp_path):
    keys(tmp_path / "keys", client="ann")
    return tmp_path / "keys"


def clients_own(folder, name, tmp_path):
    """What is carried to a client's computer."""
    own = tmp_path / name
    own.mkdir()
    (folder / f"{name}.key_secret").rename(own / f"{name}.key_secret")
    (own / "server.key").write_bytes((folder / "server.key").read_bytes())
    return own


def test_secrets_are_for_their_owner_alone(folder):
    assert {path.name for path in folder.iterdir()} == {"server.key", "server.key_secret", "ann.key_secret", "clients"}
    for path in folder.rglob("*"):
        assert not stat.S_IMODE(path.stat().st_mode) & 0o077, path


def test_a_secret_that_others_may_read_is_not_used(folder):
    (folder / "server.key_secret").chmod(0o640)
    with pytest.raises(KeysError, match="may be read by others"):
        ServerKeys(folder)


def test_without_anybody_admitted_nothing_is_served(tmp_path):
    keys(tmp_path / "k")
    with pytest.raises(KeysError, match="nobody is admitted"):
        ServerKeys(tmp_path / "k")


def test_keys_are_never_written_over(folder):
    before = (folder / "server.key_secret").read_bytes()
    with pytest.raises(InputError):
        keys(folder, client="ann")
    keys(folder, client="bob")
    assert (folder / "server.key_secret").read_bytes() == before


@pytest.mark.parametrize("name", ["../x", "server", "", "a/b"])
def test_a_name_is_a_name(folder, name):
    with pytest.raises(InputError):
        keys(folder, client=name)


def test_a_client_has_one_key(folder, tmp_path):
    keys(folder, client="bob")
    with pytest.raises(KeysError, match="2 keys"):
        ClientKeys(folder)
    with pytest.raises(KeysError, match="0 keys"):
        ClientKeys(tmp_path)


@pytest.mark.parametrize("bind", ["0.0.0.0:5570", "192.168.7.2", "[::]:5570"])
def test_what_others_can_reach_is_not_opened_without_keys(bind):
    with pytest.raises(KeysError, match="nothing guards it"):
        addresses(bind, keyed=False)
    assert all(address.startswith("tcp://") for address in addresses(bind, keyed=True).values())


def test_loopback_needs_no_keys():
    assert addresses("127.0.0.1:5570", keyed=False) == {
        "control": "tcp://127.0.0.1:5570",
        "stop": "tcp://127.0.0.1:5571",
        "telemetry": "tcp://127.0.0.1:5572",
        "preview": "tcp://127.0.0.1:5573",
    }
    assert addresses("::1", keyed=False)["control"] == "tcp://[::1]:*"


@pytest.mark.parametrize("bind", ["bench.example:1", "1.2.3.4:x", "1.2.3.4:70000", "1.2.3.4:-1", "", ":5"])
def test_what_is_no_address_is_told(bind):
    with pytest.raises(InputError):
        host_and_port(bind)


def test_the_command_says_it_in_one_line(tmp_path):
    small = tmp_path / "small.toml"
    small.write_text(SMALL_BENCH)
    result = stereotome("serve", "-i", small, "--bind", "0.0.0.0:5570")
    assert (result.code, result.err.count("error[")) == (5, 1)


def test_only_who_is_on_the_list_comes_in(start_bench, folder, tmp_path):
    keys(folder, client="mallory")
    own, strangers = clients_own(folder, "ann", tmp_path), clients_own(folder, "mallory", tmp_path)
    (folder / "clients" / "mallory.key").unlink()
    small = tmp_path / "small.toml"
    small.write_text(SMALL_BENCH.replace('"small"', '"keyed"'))
    bench = start_bench(small)
    with served(bench.instrument, "--bind", "127.0.0.1:0", "--keys", folder) as server:
        from acquire.meeting import find_meeting

        meeting = find_meeting(server.connection)
        assert meeting.key == ""
        with Instrument(meeting, keys=ClientKeys(own)) as instrument:
            instrument.command("ann")
            assert instrument.move(1.0) == pytest.approx(1.0, abs=0.2)
            instrument.wait_for(lambda state: state.holder == "ann", PATIENCE_S)
        for refused in (ClientKeys(strangers), None):
            with pytest.raises(KeysError) as error:
                Instrument(meeting, keys=refused)
            assert error.value.code == "serve-keys"
