"""From the demonstrated states to a policy everywhere: Algorithm 1 and what it is compared with (sections IV to VI)."""
