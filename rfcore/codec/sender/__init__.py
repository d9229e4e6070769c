"""The sender's part of the codec: encoding, the choice of references, rate control, the ladder."""
