"""Generated from proto/rfcore/wire/v1 by `make proto`; do not edit."""
