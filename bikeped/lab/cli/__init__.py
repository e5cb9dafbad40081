"""Commands of the lab: one thin module a command or group."""
