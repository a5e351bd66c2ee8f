//! What a bench shows along one of its axes, and with which period that repeats itself.

/// Length of a module's short side in pixels of the mask, and of its long side in parts of that, as photos show them.
pub(super) const SHORT_PX: (f64, f64) = (9.0, 46.0);
pub(super) const ELONGATION: (f64, f64) = (1.25, 3.2);
/// How far the ends of an outline may be off, in pixels of its length, and in which steps.
const END_PX: i32 = 6;
const END_STEP_PX: f64 = 0.5;
/// Step between periods where one end is open: by so many pixels the last module moves.
const OPEN_STEP_PX: f64 = 1.0;
/// The best periods that are tried at each turn, and the steps that they may change by.
const NEAR_PERIODS: usize = 4;
const NEAR_STEPS: i32 = 6;
/// The best periods of an axis that are weighed.
const MOST_PERIODS: usize = 40;
/// How far a whole bench may bend its pattern, and the end of an open one shift it, in modules; and the steps.
const BENT: f64 = 0.5;
const BENT_STEP: f64 = 0.05;

/// How one axis of a bench repeats itself.
#[derive(Debug, Clone, Copy)]
pub(super) struct Period {
    pub px: f64,
    /// Modules along the axis; a whole number where both ends are seen.
    pub count: f64,
    /// Share of the variance that it explains, adjusted for its freedom.
    pub explained: f64,
}

/// What a bench shows along one axis.
pub(super) struct Profile {
    /// Places of the axis that count.
    pub is_seen: Vec<bool>,
    /// Values along it, one row per kind of them, less what changes slowly.
    pub channels: Vec<Vec<f64>>,
}

impl Profile {
    fn length(&self) -> f64 {
        self.is_seen.len() as f64
    }

    /// The share of the variance that repeats itself with the phase (in modules) of each place, adjusted for the number of
    /// means that tell it.
    fn explained(&self, period_px: f64, phase: impl Fn(f64) -> f64) -> f64 {
        let bins = (period_px.round() as usize).max(8);
        let places: Vec<(usize, usize)> = (0..self.is_seen.len())
            .filter(|&k| self.is_seen[k])
            .map(|k| (k, ((phase(k as f64 + 0.5).rem_euclid(1.0) * bins as f64) as usize).min(bins - 1)))
            .collect();
        let mut counts = vec![0.0_f64; bins];
        for &(_, bin) in &places {
            counts[bin] += 1.0;
        }
        let freedom = counts.iter().filter(|count| **count > 0.0).count() + 1;
        if places.len() <= freedom {
            return 0.0;
        }
        let share = |values: &Vec<f64>| {
            let mut means = vec![0.0; bins];
            for &(k, bin) in &places {
                means[bin] += values[k] / counts[bin];
            }
            let rest: f64 = places.iter().map(|&(k, bin)| (values[k] - means[bin]).powi(2)).sum();
            let whole: f64 = places.iter().map(|&(k, _)| values[k].powi(2)).sum();
            if whole > 0.0 { rest / whole } else { 1.0 }
        };
        let left = self.channels.iter().map(share).sum::<f64>() / self.channels.len() as f64;
        1.0 - left * (places.len() - 1) as f64 / (places.len() - freedom) as f64
    }

    /// The most that a period close to one of the best of `periods` explains.
    pub fn explained_near(&self, periods: &[Period]) -> f64 {
        let step = OPEN_STEP_PX / self.length();
        let near = |px: f64| (-NEAR_STEPS..=NEAR_STEPS).map(move |k| px * (f64::from(k) * step).exp());
        let tried = periods.iter().take(NEAR_PERIODS).flat_map(|period| near(period.px));
        tried.map(|px| self.explained(px, |x| x / px)).fold(f64::NEG_INFINITY, f64::max)
    }

    /// The periods that explain most, best first. Where the axis is whole, it holds a whole number of modules.
    pub fn periods(&self, is_whole: bool) -> Vec<Period> {
        let (length, longest) = (self.length(), SHORT_PX.1 * ELONGATION.1);
        let mut found: Vec<Period> = Vec::new();
        if is_whole {
            for count in 1..=(length / SHORT_PX.0) as usize {
                let count = count as f64;
                if length / count > longest {
                    continue;
                }
                let ends = (-END_PX..=END_PX).map(|step| length + f64::from(step) * END_STEP_PX);
                let tried = ends.map(|end| {
                    let px = end / count;
                    let explained = if count > 1.0 { self.explained(px, |x| x / px) } else { 0.0 };
                    Period { px, count, explained }
                });
                found.extend(tried.max_by(|a, b| a.explained.total_cmp(&b.explained)));
            }
        } else {
            let steps = ((longest.min(length / 2.0) / SHORT_PX.0).ln() * length / OPEN_STEP_PX).max(0.0) as usize;
            let tried: Vec<Period> = (0..steps)
                .map(|step| SHORT_PX.0 * (step as f64 * OPEN_STEP_PX / length).exp())
                .map(|px| Period { px, count: length / px, explained: self.explained(px, |x| x / px) })
                .collect();
            found.extend(tried.windows(3).filter_map(|near| {
                let [before, own, after] = near else { return None };
                (own.explained >= before.explained && own.explained >= after.explained).then_some(*own)
            }));
        }
        found.sort_by(|a, b| b.explained.total_cmp(&a.explained));
        found.truncate(MOST_PERIODS);
        found
    }

    /// Where modules begin and end along the axis, from its start: the period, bent and, where the end is open, stretched so
    /// that it explains most, for perspective and the lens leave no pitch quite even.
    pub fn places(&self, period: &Period, is_whole: bool) -> Vec<f64> {
        let (length, count) = (self.length(), period.count);
        let phase = |x: f64, stretch: f64, bend: f64| {
            let part = x / length;
            x / period.px + stretch * part + bend * part * (part - 1.0)
        };
        let most = (BENT / BENT_STEP) as i32;
        let range = || (-most..=most).map(|step| f64::from(step) * BENT_STEP);
        let mut best = (f64::NEG_INFINITY, 0.0, 0.0);
        for stretch in range().filter(|stretch| !is_whole || *stretch == 0.0) {
            for bend in range() {
                // Straight unless the photo says otherwise.
                let explained =
                    self.explained(period.px, |x| phase(x, stretch, bend)) - 1e-3 * (stretch.abs() + bend.abs());
                if explained > best.0 {
                    best = (explained, stretch, bend);
                }
            }
        }
        let (_, stretch, bend) = best;
        let last = if is_whole { count.round() } else { (count + stretch + 0.15).floor() } as usize;
        let place = |module: usize| {
            let mut x = module as f64 * period.px;
            for _ in 0..4 {
                x -= (phase(x, stretch, bend) - module as f64) * period.px;
            }
            if is_whole { x * length / (count * period.px) } else { x }
        };
        (0..=last).map(place).collect()
    }
}
