//! Sorting by whole numbers.

/// Sorts by key, entries of equal keys in the order in which they come: by one digit after the other, the lowest first.
pub(crate) fn sorted_by_key(mut entries: Vec<(u64, u32)>) -> Vec<(u64, u32)> {
    const DIGIT_BITS: usize = 7;
    const DIGITS: usize = 1 << DIGIT_BITS;
    let used = entries.iter().fold(0, |bits, (key, _)| bits | key);
    let mut moved = vec![(0, 0); entries.len()];
    for shift in (0..u64::BITS).step_by(DIGIT_BITS) {
        let digit = |key: u64| (key >> shift) as usize % DIGITS;
        if digit(used) == 0 {
            continue;
        }
        let mut starts = [0u32; DIGITS + 1];
        entries.iter().for_each(|(key, _)| starts[digit(*key) + 1] += 1);
        (0..DIGITS).for_each(|d| starts[d + 1] += starts[d]);
        for &entry in &entries {
            let at = &mut starts[digit(entry.0)];
            moved[*at as usize] = entry;
            *at += 1;
        }
        std::mem::swap(&mut entries, &mut moved);
    }
    entries
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn entries_of_equal_keys_keep_their_order(keys in prop::collection::vec(prop_oneof![0..4u64, any::<u64>()], 0..300)) {
            let entries: Vec<(u64, u32)> = keys.into_iter().zip(0..).collect();
            let mut expected = entries.clone();
            expected.sort_by_key(|(key, _)| *key);
            prop_assert_eq!(sorted_by_key(entries), expected);
        }
    }
}
