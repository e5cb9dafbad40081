"""The configuration as typed sections: load, check, override, hash, edit."""
