//! A mapping that is taken up again: what it had found it does not look for, and its model is the same.

use crate::survey::Survey;
use heliomap_mapping::fusion::Fused;
use heliomap_mapping::pipeline::{Boxes, Found, MapError, MapOptions, Observer, Stage, Subject, map_folder};
use heliomap_model::{PlantId, PlantModel};
use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Mutex;
use uuid::Uuid;

/// What a mapping left behind, as bytes.
#[derive(Default)]
struct Kept {
    images: HashMap<String, Vec<u8>>,
    structure: Option<(String, Vec<u8>)>,
}

/// A mapping that ends at a stage, and what it saw.
#[derive(Default)]
struct Life {
    known: Mutex<Kept>,
    kept: Mutex<Kept>,
    ends_at: Option<Stage>,
    stages: Mutex<Vec<Stage>>,
}

fn bytes(value: &impl serde::Serialize) -> Vec<u8> {
    let mut bytes = Vec::new();
    ciborium::into_writer(value, &mut bytes).unwrap();
    bytes
}

impl Observer for Life {
    fn progress(&self, stage: Stage, _: usize, _: usize) {
        self.stages.lock().unwrap().push(stage);
    }

    fn cancelled(&self) -> bool {
        self.ends_at.is_some_and(|end| self.stages.lock().unwrap().contains(&end))
    }

    fn load_checkpoint(&self, image: &str) -> Option<Found> {
        let kept = self.known.lock().unwrap().images.remove(image)?;
        Some(ciborium::from_reader(kept.as_slice()).unwrap())
    }

    fn save_checkpoint(&self, found: &Found) {
        self.kept.lock().unwrap().images.insert(found.detections.image.clone(), bytes(found));
    }

    fn load_structure(&self, of: &str) -> Option<Fused> {
        let (was_of, kept) = self.known.lock().unwrap().structure.take()?;
        assert_eq!(was_of, of, "the same was seen");
        Some(ciborium::from_reader(kept.as_slice()).unwrap())
    }

    fn save_structure(&self, fused: &Fused, of: &str) {
        self.kept.lock().unwrap().structure = Some((of.to_owned(), bytes(fused)));
    }
}

fn map(survey: &Survey, life: &Life) -> Result<PlantModel, MapError> {
    let folder: PathBuf = survey.path("");
    let boxes = survey.boxes();
    let subject = Subject {
        plant: PlantId(Uuid::from_u128(7)),
        plant_name: "Example".to_owned(),
        survey: "June".to_owned(),
        previous: None,
    };
    map_folder(&folder, Boxes::File(&boxes), &MapOptions::default(), &subject, life).map(|mapping| mapping.model)
}

#[test]
fn a_mapping_that_ended_after_a_stage_goes_on_with_the_next() {
    let survey = Survey::new();
    let whole = Life::default();
    let expected = map(&survey, &whole).unwrap();
    let searched = whole.kept.into_inner().unwrap().images;

    // It ends once a stage is over: the next one begins with a look whether it should.
    let first = Life { ends_at: Some(Stage::Locate), ..Life::default() };
    assert!(matches!(map(&survey, &first), Err(MapError::Cancelled)));
    let kept = first.kept.into_inner().unwrap();
    assert_eq!((kept.images.len(), kept.structure.is_some()), (searched.len(), false));

    let second = Life { known: Mutex::new(kept), ends_at: Some(Stage::Refine), ..Life::default() };
    assert!(matches!(map(&survey, &second), Err(MapError::Cancelled)));
    let mut kept = second.kept.into_inner().unwrap();
    assert!(kept.images.is_empty(), "nothing is found twice");
    assert!(kept.structure.is_some());

    kept.images = searched;
    let third = Life { known: Mutex::new(kept), ..Life::default() };
    let model = map(&survey, &third).unwrap();
    let stages = third.stages.into_inner().unwrap();
    assert!(!stages.contains(&Stage::Locate) && !stages.contains(&Stage::Fuse), "{stages:?}");
    let kept = third.kept.into_inner().unwrap();
    assert!(kept.images.is_empty() && kept.structure.is_none());
    assert_eq!(serde_json::to_string(&model).unwrap(), serde_json::to_string(&expected).unwrap());
}
