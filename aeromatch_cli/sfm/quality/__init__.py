"""Whether an adjusted block can be trusted; `judgement.judged` gives the verdict."""
