"""What a user gets to see who asks for what cannot be done."""


def refused(result: tuple[int, str], *words: str) -> None:
    """Asserts exit code 2 and a message, without a traceback, that holds all `words`."""
    code, message = result
    assert code == 2
    assert "Traceback" not in message
    for word in words:
        assert word in message
