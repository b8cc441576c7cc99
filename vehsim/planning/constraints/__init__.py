"""The constraints of a planned motion: each is one block, see `block.Block`; `blocks.blocks_of` lists them."""
