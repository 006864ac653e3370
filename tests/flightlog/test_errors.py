import pytest

from flightlog import errors

TREE = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.SwathError)]


@pytest.mark.parametrize("kind", TREE)
def test_every_error_is_explained_and_has_an_exit_code(kind: type[errors.SwathError]) -> None:
    assert kind.exit_code in (1, 2)
    assert kind.__doc__


def test_only_what_the_user_asked_wrongly_exits_with_two() -> None:
    assert {kind for kind in TREE if kind.exit_code == 2} == {errors.UsageError, errors.ConfigError}


def test_the_message_is_the_sentence_and_nothing_else() -> None:
    assert str(errors.LogError("a.mcap: is no MCAP file")) == "a.mcap: is no MCAP file"
