"""Roll and pitch of a body that is accelerated."""
