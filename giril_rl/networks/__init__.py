"""Network bodies alone: perceptrons, convolutions, normalisers, distributions."""
