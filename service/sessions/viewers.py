"""Who may watch sessions."""

from __future__ import annotations

from hashlib import sha256

from service.errors import Kind, Refused
from service.sessions.identity import check_secret, is_among
from service.settings import Settings


class ViewerTokens:
    """The tokens of those who may watch. Without any, whoever may use the gateway may, where it asks for no API key;
    where it asks for one, nobody.

    Parameters
    ----------
    settings : Settings
    open_to_all : bool
        Whether the gateway asks for no API key. It then serves its own machine only.

    Raises
    ------
    ValueError
        If a token is too short or could not be sent; it is not shown.
    """

    def __init__(self, settings: Settings, *, open_to_all: bool) -> None:
        tokens = [token.get_secret_value() for token in settings.viewer_tokens]
        for number, token in enumerate(tokens, 1):
            check_secret(f"ROBOSAC_VIEWER_TOKENS: token {number}", token)
        self._digests = [sha256(token.encode()).digest() for token in tokens]
        self._open = open_to_all and not tokens

    def has(self, token: str | None) -> bool:
        """Whether it is one of them."""
        return is_among(token, self._digests)

    def check(self, token: str | None) -> None:
        """Refuse whoever may not watch.

        Raises
        ------
        Refused
            With the kind ``unauthenticated``.
        """
        if self._open or self.has(token):
            return
        detail = "a viewer's token is needed as a bearer token"
        if not self._digests:
            detail += "; the gateway has none yet (ROBOSAC_VIEWER_TOKENS)"
        raise Refused(Kind.UNAUTHENTICATED, detail)
