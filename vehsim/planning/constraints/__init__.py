"""What a planned motion has to meet: each constraint is one block, see `block.Block`; `build.blocks_of` lists them."""
