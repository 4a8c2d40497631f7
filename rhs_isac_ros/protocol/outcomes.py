"""The outcomes that roles count, each with its kind."""

import enum


class Kind(enum.Enum):
    """Kind of an outcome; the value is the name of its section in the diagnostics."""

    DROPPED = 'dropped'    # a message was ignored
    REPEATED = 'retries'   # a step of a cycle was requested again
    LOST = 'cycles'        # a cycle ended without service
    IDLE = 'beacons'       # a beacon without acks, a user without acks, or no beacon at all


@enum.unique
class Outcome(enum.Enum):
    """A countable outcome; the value is the name of its counter."""

    kind: Kind

    def __new__(cls, counter: str, kind: Kind) -> 'Outcome':
        """Create a member whose value is its counter."""
        member = object.__new__(cls)
        member._value_ = counter
        member.kind = kind
        return member

    # A message that belongs to no step of the current cycle, or that is rejected.
    WRONG_CYCLE = 'wrong_cycle', Kind.DROPPED
    WRONG_USER = 'wrong_user', Kind.DROPPED
    WRONG_INSTANCE = 'wrong_instance', Kind.DROPPED
    WRONG_SCENARIO = 'wrong_scenario', Kind.DROPPED
    NUMBER_TAKEN = 'number_taken', Kind.DROPPED
    WRONG_BAND = 'wrong_band', Kind.DROPPED
    WRONG_CODEBOOK = 'wrong_codebook', Kind.DROPPED
    DUPLICATE = 'duplicate', Kind.DROPPED
    LATE_ACK = 'late_ack', Kind.DROPPED
    NOT_ALLOWED = 'not_allowed', Kind.DROPPED
    TOO_OFTEN = 'too_often', Kind.DROPPED
    STALE_BEACON = 'stale_beacon', Kind.DROPPED
    LATE_GRANT = 'late_grant', Kind.DROPPED
    STALE_COMMAND = 'stale_command', Kind.DROPPED
    STALE = 'stale', Kind.DROPPED
    OVERFLOW = 'overflow', Kind.DROPPED

    RETRY_RHS = 'retry_rhs', Kind.REPEATED
    RETRY_BAND = 'retry_band', Kind.REPEATED
    RETRY_POSITION = 'retry_position', Kind.REPEATED
    RETRY_BEAM = 'retry_beam', Kind.REPEATED
    RETRY_DATA = 'retry_data', Kind.REPEATED
    ASKED_AGAIN = 'asked_again', Kind.REPEATED

    # A cycle that ended without service, as counted by the base station.
    RHS_SILENT = 'rhs_silent', Kind.LOST
    USER_GONE = 'user_gone', Kind.LOST
    NO_FIX = 'no_fix', Kind.LOST
    POSITIONER_SILENT = 'positioner_silent', Kind.LOST
    TRANSMISSION_SILENT = 'transmission_silent', Kind.LOST
    DATA_LOST = 'data_lost', Kind.LOST
    # A cycle that ended without service, as counted by its user.
    NOT_GRANTED = 'not_granted', Kind.LOST
    ABANDONED = 'abandoned', Kind.LOST
    BS_SILENT = 'bs_silent', Kind.LOST

    UNANSWERED = 'unanswered', Kind.IDLE
    USER_LOST = 'user_lost', Kind.IDLE
    NO_BEACON = 'no_beacon', Kind.IDLE


_BY_COUNTER = {outcome.value: outcome for outcome in Outcome}


def kind_of(counter: str) -> Kind:
    """Return the kind of a counter; counters without an `Outcome` count dropped messages."""
    outcome = _BY_COUNTER.get(counter)
    return outcome.kind if outcome else Kind.DROPPED
