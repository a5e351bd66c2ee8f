//! Figures of many photos: all, per plant or set, per condition, per photo.

use super::PhotoScore;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;

/// A photo is one with glare where more than this share of its modules is saturated.
const GLARE_PHOTO: f64 = 0.01;

/// What many photos come to. Shares are in percent, as people write them.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    pub photos: usize,
    /// Modules wholly inside their frames.
    pub modules: usize,
    pub found: usize,
    pub recall_percent: f64,
    /// The lowest recall of a photo, and its name.
    pub worst_recall_percent: f64,
    pub worst_image: Option<String>,
    pub boxes: usize,
    pub false_boxes: usize,
    pub precision_percent: f64,
    pub mean_iou: Option<f64>,
    pub median_center_error_px: Option<f64>,
    /// Median area of the boxes in parts of the modules'.
    pub median_area_ratio: Option<f64>,
    pub splits: usize,
    pub merges: usize,
    /// Modules that glare saturates, and how many of them are found.
    pub glare_modules: usize,
    pub glare_found: usize,
    /// Of the modules without glare.
    pub recall_without_glare_percent: f64,
    /// Boxes from U-Net, YOLO and outside.
    pub by_source: [usize; 3],
}

impl Summary {
    /// Of photos; without any, nothing was missed.
    pub fn of<'a>(scores: impl IntoIterator<Item = &'a PhotoScore>) -> Self {
        let scores: Vec<&PhotoScore> = scores.into_iter().collect();
        let sum = |count: fn(&PhotoScore) -> usize| scores.iter().map(|score| count(score)).sum::<usize>();
        let gather = |values: fn(&PhotoScore) -> &Vec<f64>| -> Vec<f64> {
            scores.iter().flat_map(|score| values(score).iter().copied()).collect()
        };
        let percent = |part: usize, whole: usize| if whole > 0 { 100.0 * part as f64 / whole as f64 } else { 100.0 };
        let (modules, found, boxes) = (sum(|s| s.modules), sum(|s| s.found), sum(|s| s.boxes));
        let false_boxes = sum(|s| s.false_boxes);
        let (glare_modules, glare_found) = (sum(|s| s.glare_modules), sum(|s| s.glare_found));
        let worst = scores
            .iter()
            .filter(|score| score.modules > 0)
            .min_by(|a, b| percent(a.found, a.modules).total_cmp(&percent(b.found, b.modules)));
        let ious = gather(|s| &s.ious);
        let by_source = [0, 1, 2].map(|source| scores.iter().map(|score| score.by_source[source]).sum());
        Self {
            photos: scores.len(),
            modules,
            found,
            recall_percent: percent(found, modules),
            worst_recall_percent: worst.map_or(100.0, |score| percent(score.found, score.modules)),
            worst_image: worst.map(|score| format!("{}/{}", score.group, score.image)),
            boxes,
            false_boxes,
            precision_percent: percent(boxes - false_boxes, boxes),
            mean_iou: (!ious.is_empty()).then(|| ious.iter().sum::<f64>() / ious.len() as f64),
            median_center_error_px: median(gather(|s| &s.center_errors_px)),
            median_area_ratio: median(gather(|s| &s.area_ratios)),
            splits: sum(|s| s.splits),
            merges: sum(|s| s.merges),
            glare_modules,
            glare_found,
            recall_without_glare_percent: percent(found - glare_found, modules - glare_modules),
            by_source,
        }
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let middle = values.len() / 2;
    let above = *values.get(middle)?;
    Some(if values.len() % 2 == 1 { above } else { (values[middle - 1] + above) / 2.0 })
}

/// The figures of an evaluation.
#[derive(Debug, Clone, Serialize)]
pub struct DetectionReport {
    /// What found the boxes.
    pub detector: String,
    pub all: Summary,
    /// Per plant or set.
    pub groups: BTreeMap<String, Summary>,
    /// Per condition that holds for a photo; a photo counts in each of its own.
    pub conditions: BTreeMap<String, Summary>,
    pub photos: Vec<PhotoSummary>,
}

/// One photo in a report.
#[derive(Debug, Clone, Serialize)]
pub struct PhotoSummary {
    #[serde(flatten)]
    pub score: PhotoScore,
    pub figures: Summary,
}

impl DetectionReport {
    /// Sums up the scores of photos.
    pub fn new(detector: String, scores: Vec<PhotoScore>) -> Self {
        let mut groups: BTreeMap<String, Vec<&PhotoScore>> = BTreeMap::new();
        let mut conditions: BTreeMap<String, Vec<&PhotoScore>> = BTreeMap::new();
        for score in &scores {
            groups.entry(score.group.clone()).or_default().push(score);
            for condition in &score.conditions {
                conditions.entry(condition.clone()).or_default().push(score);
            }
            let glare = score.glare_modules as f64 > GLARE_PHOTO * score.modules as f64;
            conditions.entry(if glare { "glare" } else { "no glare" }.to_owned()).or_default().push(score);
        }
        let summed = |parts: BTreeMap<String, Vec<&PhotoScore>>| {
            parts.into_iter().map(|(name, scores)| (name, Summary::of(scores))).collect()
        };
        let (groups, conditions) = (summed(groups), summed(conditions));
        let all = Summary::of(&scores);
        let photos = scores
            .into_iter()
            .map(|score| {
                let figures = Summary::of([&score]);
                PhotoSummary { score, figures }
            })
            .collect();
        Self { detector, all, groups, conditions, photos }
    }

    /// The figures per photo, as a table.
    pub fn photo_table(&self) -> String {
        let mut text = heading("photo");
        for photo in &self.photos {
            text.push_str(&row(&format!("{}/{}", photo.score.group, photo.score.image), &photo.figures));
        }
        text
    }
}

fn heading(what: &str) -> String {
    format!(
        "{what:<28} {:>6} {:>7} {:>7} {:>8} {:>9} {:>6} {:>7} {:>6} {:>6} {:>6} {:>12}\n",
        "module", "recall", "worst", "no glare", "precision", "IoU", "center", "area", "splits", "merges", "glare"
    )
}

fn row(name: &str, s: &Summary) -> String {
    let or_dash = |value: Option<f64>, digits: usize| value.map_or_else(|| "-".to_owned(), |v| format!("{v:.digits$}"));
    format!(
        "{name:<28} {:>6} {:>7.2} {:>7.2} {:>8.2} {:>9.2} {:>6} {:>7} {:>6} {:>6} {:>6} {:>12}\n",
        s.modules,
        s.recall_percent,
        s.worst_recall_percent,
        s.recall_without_glare_percent,
        s.precision_percent,
        or_dash(s.mean_iou, 3),
        or_dash(s.median_center_error_px, 3),
        or_dash(s.median_area_ratio, 3),
        s.splits,
        s.merges,
        if s.glare_modules > 0 { format!("{} of {}", s.glare_found, s.glare_modules) } else { "-".to_owned() },
    )
}

impl fmt::Display for DetectionReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.detector)?;
        writeln!(
            f,
            "Shares in percent of modules wholly inside the frame; centre errors are medians in pixels; glare: saturated \
             modules that are found.\n"
        )?;
        f.write_str(&heading("plant"))?;
        for (name, summary) in &self.groups {
            f.write_str(&row(name, summary))?;
        }
        f.write_str(&row("all", &self.all))?;
        if !self.conditions.is_empty() {
            write!(f, "\n{}", heading("condition"))?;
            for (name, summary) in &self.conditions {
                f.write_str(&row(name, summary))?;
            }
        }
        let [unet, yolo, external] = self.all.by_source;
        writeln!(f, "\nBoxes from the U-Net {unet}, from YOLO {yolo}, from outside {external}.")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn score(image: &str, modules: usize, found: usize, glare: (usize, usize)) -> PhotoScore {
        PhotoScore {
            image: image.to_owned(),
            group: "p".to_owned(),
            conditions: vec!["dirt".to_owned()],
            modules,
            found,
            boxes: found + 1,
            false_boxes: 1,
            splits: 0,
            merges: 0,
            glare_modules: glare.0,
            glare_found: glare.1,
            by_source: [found + 1, 0, 0],
            ious: vec![0.9; found],
            center_errors_px: (0..found).map(|k| k as f64).collect(),
            area_ratios: vec![1.0; found],
            missed: Vec::new(),
            wrong: Vec::new(),
        }
    }

    #[test]
    fn figures_add_up_and_glare_stands_apart() {
        let report = DetectionReport::new(
            "a detector".to_owned(),
            vec![score("a", 100, 90, (10, 0)), score("b", 100, 100, (0, 0))],
        );
        assert!((report.all.recall_percent - 95.0).abs() < 1e-9);
        assert!((report.all.worst_recall_percent - 90.0).abs() < 1e-9);
        assert_eq!(report.all.worst_image.as_deref(), Some("p/a"));
        assert!((report.all.recall_without_glare_percent - 100.0).abs() < 1e-9);
        assert!((report.all.precision_percent - 100.0 * 190.0 / 192.0).abs() < 1e-9);
        assert_eq!(report.conditions.keys().collect::<Vec<_>>(), ["dirt", "glare", "no glare"]);
        let text = report.to_string();
        assert!(text.contains("0 of 10") && text.contains("95.00"), "{text}");
        let empty = Summary::of([]);
        assert!(empty.recall_percent == 100.0 && empty.mean_iou.is_none());
        assert_eq!(median(vec![3.0, 1.0, 2.0, 10.0]), Some(2.5));
    }
}
