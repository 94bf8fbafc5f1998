"""Messages of `qedgix.v1`, generated from the protocol buffers by `generate`."""
