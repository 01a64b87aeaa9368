"""Who may use the headset page: a code of eight digits lets one wearer in, which comes back by its session.

The code is shown to the operator alone. It changes once it has been used, or after some wrong ones. Times and
randomness are passed in.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from dataclasses import dataclass

from share.timing import TokenBucket, TokenBuckets

CODE_DIGITS = 8
MAX_WRONG = 1000  # codes given, after which a new one is shown: fewer would let a stranger change it at will
_ADDRESS_LIMIT = (3.0, 0.1)  # codes at once, and a second, of an address
_LIMIT = (20.0, 2.0)  # of all together, which twenty addresses use up: a guess hits with 0.007 % in an hour
_MAX_ADDRESSES = 1024


class PairingError(Exception):
    """A wearer is not let in; the text is for it."""


@dataclass
class PairingDesk:
    """Checks codes. draw: returns a random integer below its argument."""

    draw: Callable[[int], int]

    def __post_init__(self) -> None:
        self.code, self.wrong_count = "", 0
        self._wrong_of_code = 0
        self._of_all, self._of_address = TokenBucket(*_LIMIT), TokenBuckets(*_ADDRESS_LIMIT)
        self.renew()

    def renew(self) -> None:
        """Show another code."""
        old = self.code
        while self.code == old:
            self.code = f"{self.draw(10**CODE_DIGITS):0{CODE_DIGITS}d}"
        self._wrong_of_code = 0

    def check(self, given: str, address: str, now_ns: int) -> None:
        """Check a code from an address. Raises PairingError. Whoever is let in by it renews it."""
        is_crowded = self._of_address.count_used(now_ns) >= _MAX_ADDRESSES
        if is_crowded or not self._of_address.bucket(address, now_ns).take(now_ns):
            raise PairingError("too many codes from this address; wait ten seconds")
        if not self._of_all.take(now_ns):
            raise PairingError("too many codes were tried; wait some seconds")
        if hmac.compare_digest(given.encode(), self.code.encode()):
            return
        self.wrong_count += 1
        self._wrong_of_code += 1
        if self._wrong_of_code >= MAX_WRONG:
            self.renew()
        raise PairingError("this is not the code that the edge shows")
