"""What only the sender needs: encoding, the choice of references, rate, ladder and poses."""
